"""Builds that are killed at a random moment and started again: is the bundle the same, byte for byte?

The command itself, in a process of its own, as a person starts it; SIGKILL for its whole group, so nothing gets to tidy up.
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
#: What says when, not what.
_TIMESTAMPS = ("made_at",)
_COMMAND = (sys.executable, "-c", "from service.cli.main import main; main()", "build-map")


def identical_bundles(
    dataset: Path, work: Path, builds: int = 20, seed: int = 0, *, options: tuple[str, ...] = ()
) -> tuple[int, ...]:
    """Kill builds and start them again.

    Args:
        dataset: folder of a dataset with a survey.
        work: folder for the bundles; those of a former run are removed.
        builds: how many are killed, each once, at a moment drawn uniformly over the time that the undisturbed one took.
        seed: of the moments.
        options: further ones of ``build-map``.

    Returns:
        For each build 1 if all files are those of the undisturbed one but for timestamps, else 0: their sum is the number of identical
        ones.

    Raises:
        RuntimeError: a build fails of itself, or leaves half a bundle.
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
    # A group of its own, so that the kill reaches every process of the build and no other.
    process = subprocess.Popen(
        arguments, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True, text=True
    )  # fmt: skip
    try:
        _, told = process.communicate(timeout=kill_after_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return
    if process.returncode != 0:
        raise RuntimeError(f"build-map ended with {process.returncode}: {told[-2000:]}")


def content_of(bundle: Path) -> dict[str, bytes]:
    """Every file by its name; of the manifest all but its timestamps."""
    files = {path.relative_to(bundle).as_posix(): path for path in sorted(bundle.rglob("*")) if path.is_file()}
    content = {name: path.read_bytes() for name, path in files.items()}
    manifest = json.loads(content[MANIFEST])
    for key in _TIMESTAMPS:
        manifest[key] = None
    content[MANIFEST] = json.dumps(manifest, sort_keys=True).encode()
    return content
