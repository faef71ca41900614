"""Run the code blocks of README and docs as a reader would, page after page, in a temporary folder.

The fence gives the kind of a block. ``sh`` and ``python`` run, ``json`` and ``yaml`` must parse, ``text`` is not code.
A comment ``<!-- not run: WHY -->`` above a fence says why the block cannot run here. A comment ``<!-- file: NAME -->``
writes the block to a file first. ``streetfix serve`` runs in the background until its block ends. A block that needs a
service, but does not start one, gets one.
"""

import json
import os
import re
import shlex
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml

from benchmarks.report import ROOT

#: The README comes first: it makes the dataset and the map that the other pages use.
PAGES = (
    "README.md",
    "start",
    "survey",
    "recordings",
    "maps",
    "robot",
    "nav2",
    "python",
    "deploy",
    "serving",
    "operate",
    "console",
    "confidence",
    "measuring",
    "train",
    "api",
    "problems",
    "formats",
    "how_it_works",
    "architecture",
    "paper",
    "scale",
    "limits",
    "faq",
    "index",
    "contributing",
    "development",
    "decisions/index",
)
KINDS = ("sh", "python", "json", "yaml", "text")
_MARK = re.compile(r"<!-- (not run|file): (.+) -->")
#: Addresses in the pages. Free ports replace them here.
_HTTP, _GRPC = "127.0.0.1:8000", "50051"
_BLOCK_S, _READY_S = 1800.0, 90.0


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block.

    Attributes:
        page: name of the file.
        line: line of the fence, from 1.
        kind: one of ``KINDS``.
        text: content.
        why_not: reason why it is not run; None if it runs.
        file: file to write the text to; None for none.
    """

    page: str
    line: int
    kind: str
    text: str
    why_not: str | None
    file: str | None

    @property
    def runs(self) -> bool:
        """Whether the block can run or parse here."""
        return self.kind != "text" and self.why_not is None


def pages() -> list[Path]:
    """Return README and every page of ``docs`` in the order in which they run."""
    return [ROOT / name if name.endswith(".md") else ROOT / "docs" / f"{name}.md" for name in PAGES]


def blocks_of(page: Path) -> list[Block]:
    """Return all fenced blocks of a page.

    Args:
        page: Markdown file.

    Raises:
        ValueError: a fence has no known kind, or is not closed.
    """
    found, lines, number = [], page.read_text().splitlines(), 0
    while number < len(lines):
        if not lines[number].startswith("```"):
            number += 1
            continue
        kind, start = lines[number][3:].strip(), number
        if kind not in KINDS:
            raise ValueError(f"{page.name}, line {start + 1}: the fence says {kind!r}, not one of {', '.join(KINDS)}")
        try:
            number = lines.index("```", start + 1)
        except ValueError:
            raise ValueError(f"{page.name}, line {start + 1}: the fence is not closed") from None
        mark = _MARK.fullmatch(lines[start - 1].strip()) if start else None
        marked = {} if mark is None else {mark[1]: mark[2]}
        text = "\n".join(lines[start + 1 : number])
        found.append(Block(page.name, start + 1, kind, text, marked.get("not run"), marked.get("file")))
        number += 1
    return found


def commands_of(block: Block) -> list[str]:
    """Return the commands of a shell block without comments; a continued line is one command.

    Args:
        block: a block of kind ``sh``.
    """
    joined = block.text.replace("\\\n", " ")
    bare = [re.sub(r"\s+#\s.*$", "", line).strip() for line in joined.splitlines()]
    return [line for line in bare if line and not line.startswith("#")]


def code_blocks_run(only: tuple[str, ...] = PAGES) -> tuple[int, int]:
    """Run the blocks that can run; print each result; return how many ran and how many should.

    Args:
        only: names of the pages.
    """
    blocks = [block for page, name in zip(pages(), PAGES, strict=True) if name in only for block in blocks_of(page)]
    wanted = [block for block in blocks if block.runs]
    ran = 0
    with tempfile.TemporaryDirectory(prefix="docs-blocks-") as folder:
        work = Path(folder)
        environment = _environment(work)
        for block in wanted:
            began = time.monotonic()
            failure = _failure(block, work, environment)
            ran += failure is None
            print(
                f"{block.page}:{block.line} {block.kind}: {failure or 'ran'} ({time.monotonic() - began:.0f} s)",
                flush=True,
            )
    return ran, len(wanted)


def _environment(work: Path) -> dict[str, str]:
    """Return an environment with this interpreter's ``streetfix`` on the path and free ports."""
    program = work / ".bin" / "streetfix"
    program.parent.mkdir()
    program.write_text(
        f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -c "from service.cli.main import main; main()" "$@"\n'
    )
    program.chmod(0o755)
    return os.environ | {
        "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "STREETFIX_PORT": str(_free_port()),
        "ORT_DISABLE_TELEMETRY": "1",
    }


def _free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def _failure(block: Block, work: Path, environment: dict[str, str]) -> str | None:
    """Run or parse a block; return the failure, or None."""
    if block.file is not None:
        (work / block.file).write_text(block.text + "\n")
    try:
        if block.kind == "json":
            json.loads(block.text)
        elif block.kind == "yaml":
            yaml.safe_load(block.text)
        else:
            _run(block, work, environment)
    except (ValueError, yaml.YAMLError, subprocess.SubprocessError, TimeoutError) as error:
        output = getattr(error, "output", None) or ""
        return f"FAILED: {error}\n{output[-2000:]}"
    return None


def _run(block: Block, work: Path, environment: dict[str, str]) -> None:
    address = f"127.0.0.1:{environment['STREETFIX_PORT']}"
    commands = [block.text] if block.kind == "python" else commands_of(block)
    grpc_port = _free_port()
    commands = [command.replace(_HTTP, address).replace(_GRPC, str(grpc_port)) for command in commands]
    serves = [command for command in commands if _serves(command)]
    asks_grpc = any(f"127.0.0.1:{grpc_port}" in command for command in commands)
    asks = asks_grpc or any(address in command for command in commands)
    service = f"streetfix serve maps/small{f' --grpc-port {grpc_port}' if asks_grpc else ''}"
    with _in_background(service if asks and not serves else None, work, environment):
        if block.kind == "python":
            _call([sys.executable, "-c", commands[0]], work, environment)
            return
        with _in_background(serves[0] if serves else None, work, environment):
            for command in commands:
                if command not in serves:
                    _call(["bash", "-euo", "pipefail", "-c", command], work, environment)


def _serves(command: str) -> bool:
    return "streetfix serve" in command and "--check" not in command


def _call(arguments: list[str], work: Path, environment: dict[str, str]) -> None:
    subprocess.run(
        arguments,
        cwd=work,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=True,
        timeout=_BLOCK_S,
    )


@contextmanager
def _in_background(command: str | None, work: Path, environment: dict[str, str]) -> Iterator[None]:
    """Run a ready service for as long as a block lasts; nothing for None."""
    if command is None:
        yield
        return
    process = subprocess.Popen(
        shlex.split(command), cwd=work, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        _wait_until_ready(f"http://127.0.0.1:{environment['STREETFIX_PORT']}/readyz", process)
        yield
    finally:
        process.terminate()
        process.wait(timeout=60)


def _wait_until_ready(url: str, process: "subprocess.Popen[bytes]") -> None:
    until = time.monotonic() + _READY_S
    while time.monotonic() < until:
        if process.poll() is not None:
            raise subprocess.CalledProcessError(process.returncode, process.args)
        try:
            urllib.request.urlopen(url, timeout=2).close()  # noqa: S310  # our own URL
        except OSError:  # not ready yet
            time.sleep(0.2)
        else:
            return
    raise TimeoutError(f"{url} is not ready after {_READY_S:g} s")
