"""The demo's map and samples, and the real service over them."""

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from benchmarks.report import ROOT
from service.maps.manifest import FILE, read_manifest

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
DEMO = ROOT / "out" / "demo"


@dataclass(frozen=True, slots=True)
class Demo:
    """Output of ``streetfix demo``.

    Attributes:
        bundle: folder of the map bundle.
        samples: folder of the sample queries.
    """

    bundle: Path
    samples: Path


def demo() -> Demo:
    """Return the demo's folders; run the user's command if they are absent."""
    found = Demo(DEMO / "map", DEMO / "samples")
    if not (found.bundle / FILE).exists() or not found.samples.is_dir():
        subprocess.run([*COMMAND, "demo", "--once"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return found


def other_version(bundle: Path, out: Path) -> str:
    """Write the same map as another version with another licence and a later date, by hard links; return its version.

    Args:
        bundle: the map bundle.
        out: folder of the new version.
    """
    shutil.copytree(bundle, out, copy_function=os.link)
    manifest = read_manifest(bundle)
    changed = manifest.model_copy(
        update={"licence": "CC0-1.0", "made_at": manifest.made_at + timedelta(days=1)}
    ).stamped()
    (out / FILE).unlink()  # a hard link: keep the original
    (out / FILE).write_bytes(changed.to_bytes())
    return changed.version


@contextmanager
def serving(*arguments: str | Path) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Run ``streetfix serve``; yield its address and its process.

    Args:
        *arguments: further arguments of the command.
    """
    process = subprocess.Popen(
        [*COMMAND, "serve", *map(str, arguments), "--port", "0"], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        yield _address(process), process
    finally:
        process.send_signal(signal.SIGCONT)  # a stopped process does not handle SIGTERM
        process.terminate()
        process.communicate(timeout=60)


def _address(process: "subprocess.Popen[str]") -> str:
    for line in process.stdout or ():
        if found := re.search(r"serving at (http://\S+)", line):
            return found[1]
    raise RuntimeError(f"the service ended with {process.wait()} before it was ready")
