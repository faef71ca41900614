"""Kill map builds at random times, start them again, and compare the bundles byte by byte.

The build is the real command in its own process. SIGKILL goes to its whole process group, so no process can clean up.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

MANIFEST = "manifest.json"
#: Fields of the manifest that differ between equal bundles.
_TIMESTAMPS = ("made_at",)
_COMMAND = (sys.executable, "-c", "from service.cli.main import main; main()", "build-map")


def identical_bundles(
    dataset: Path, work: Path, builds: int = 20, seed: int = 0, *, options: tuple[str, ...] = ()
) -> tuple[int, ...]:
    """Kill builds and start them again.

    Args:
        dataset: folder of a dataset with a survey.
        work: folder of the bundles. Bundles of an earlier run are removed.
        builds: number of builds. Each is killed once, at a random time within the duration of an undisturbed build.
        seed: seed of the times.
        options: further options of ``build-map``.

    Returns:
        For each build 1 if all files equal those of the undisturbed build except for timestamps, else 0.

    Raises:
        RuntimeError: a build fails without a kill, or leaves an incomplete bundle.
    """
    rng = np.random.default_rng(seed)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    began = time.monotonic()
    _built(dataset, work / "undisturbed", options, kill_after_s=None)
    took_s = time.monotonic() - began
    expected = content_of(work / "undisturbed")
    found = []
    for number in range(builds):
        out = work / f"killed-{number:02d}"
        _built(dataset, out, options, kill_after_s=float(rng.uniform(0.0, took_s)))
        if out.exists() and not (out / MANIFEST).exists():
            raise RuntimeError(f"{out} is an incomplete bundle after the kill")
        if not out.exists():
            _built(dataset, out, options, kill_after_s=None)
        found.append(int(content_of(out) == expected))
        shutil.rmtree(out)
    return tuple(found)


def _built(dataset: Path, out: Path, options: tuple[str, ...], *, kill_after_s: float | None) -> None:
    arguments = [*_COMMAND, str(dataset), "--out", str(out), "--name", "resumed", *options]
    # Its own process group: the kill reaches every process of the build and no other process.
    process = subprocess.Popen(
        arguments,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    try:
        _, errors = process.communicate(timeout=kill_after_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return
    if process.returncode != 0:
        raise RuntimeError(f"build-map ended with {process.returncode}: {errors[-2000:]}")


def content_of(bundle: Path) -> dict[str, bytes]:
    """Return the content of every file by name. Timestamps of the manifest are removed.

    Args:
        bundle: folder of a map bundle.
    """
    files = {path.relative_to(bundle).as_posix(): path for path in sorted(bundle.rglob("*")) if path.is_file()}
    content = {name: path.read_bytes() for name, path in files.items()}
    manifest = json.loads(content[MANIFEST])
    for key in _TIMESTAMPS:
        manifest[key] = None
    content[MANIFEST] = json.dumps(manifest, sort_keys=True).encode()
    return content
