"""The client works with the packages that a plain installation brings, and with fewer where it is given encoded images.

A hook in a fresh interpreter hides every other installed distribution.
"""

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.house.installation import distributions_of

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = packages_distributions()
#: What a client that is given encoded images needs.
LEAST = {"httpx", "jaxtyping", "numpy", "pydantic"}

HOOK = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
HIDDEN = {hidden!r}
sys.meta_path.insert(0, Hidden())
"""

ASK = """
import asyncio, json
import httpx, numpy as np
from streetfix import AsyncClient, Client, PinholeCamera, Prior, PriorPosition
POSE = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}, "heading_deg": 90,
        "covariance": None}
ANSWER = {"status": "LOCALIZED", "confidence": 0.75, "pose": POSE, "vehicle_pose": None, "geopose": None, "hypotheses": [],
          "street": {"id": "s2", "name": "End", "street": "4", "section": "end", "class_index": 6, "vote": 0.5},
          "spread": None, "reasons": [], "neighbours": [], "map": {"name": "tiny", "version": "abc"},
          "timings_ms": {"decode": 1, "fuse": 1, "encode": 1, "search": 1, "register": 1, "total": 5}}
def handler(request):
    sent.append(request.content)
    return httpx.Response(200, json=ANSWER)
sent, transport = [], httpx.MockTransport(handler)
about = {"T_vehicle_camera": np.eye(4), "gravity": (0, 1, 0), "prior": Prior(position=PriorPosition(x=1, y=2))}
camera = PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
async def ask():
    async with AsyncClient("http://x:1", transport=transport) as client:
        return await client.localize(*images, camera, **about)
def localize():
    with Client("http://x:1", transport=transport) as client:
        answers = [client.localize(*images, camera, **about), asyncio.run(ask())]
    print([answer.status for answer in answers])
"""
FILES = "images = b'colour file', b'depth file'\n"
ARRAYS = "images = np.full((4, 6, 3), 7, np.uint8), np.full((4, 6), 2.5, np.float32)\n"


def hidden_beside(requirements: Iterable[str]) -> set[str]:
    """Top-level modules of all other distributions that are installed here, except our own."""
    shown = distributions_of(requirements) | {"streetfix"}
    return {module for module, names in MODULES.items() if not shown & {canonicalize_name(name) for name in names}}


def run(program: str, requirements: Iterable[str]) -> "subprocess.CompletedProcess[str]":
    """Run a program in an interpreter that has no other distributions."""
    told = HOOK.format(hidden=hidden_beside(requirements)) + program
    return subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=False, cwd=ROOT)


def test_the_base_has_at_most_six_packages() -> None:
    names = {re.split(r"[><=;\[]", each)[0] for each in PROJECT["dependencies"]}
    assert len(names) <= 6
    assert names >= LEAST


def test_files_are_sent_with_the_least_packages() -> None:
    done = run(ASK + FILES + "localize(); print(all(b'colour file' in each for each in sent))", LEAST)
    assert (done.stdout, done.stderr) == ("['LOCALIZED', 'LOCALIZED']\nTrue\n", "")


def test_arrays_are_sent_with_what_a_plain_installation_brings() -> None:
    done = run(
        ASK + ARRAYS + "localize(); print(all(b'SFD1' in each and b'JFIF' in each for each in sent))",
        PROJECT["dependencies"],
    )
    assert (done.stdout, done.stderr) == ("['LOCALIZED', 'LOCALIZED']\nTrue\n", "")


def test_a_bad_argument_is_told_without_the_service() -> None:
    program = (
        "from streetfix import StreetfixError\ncamera = PinholeCamera(6, 4, 0.0, 3.0, 2.5, 1.5)\ntry: localize()\n"
    )
    done = run(ASK + FILES + program + "except StreetfixError as error: print(error.field)", LEAST)
    assert (done.stdout, done.stderr) == ("camera.fx\n", "")


@pytest.mark.parametrize(
    ("program", "needed_by", "remedy"),
    [
        ("from streetfix import GrpcClient", "GrpcClient", 'pip install ".[grpc]"'),
        ("from service.client import GrpcClient", "GrpcClient", 'pip install ".[grpc]"'),
        ("from streetfix import Localizer", "streetfix.Localizer", 'pip install ".[server]"'),
        ("from streetfix import MapBundle", "streetfix.MapBundle", 'pip install ".[server]"'),
        (
            f"{ASK}{ARRAYS}Client('http://x:1', transport=transport, depth_codec='lz4').localize(*images, camera)",
            "depth_codec 'lz4'",
            'pip install ".[lz4]"',
        ),
    ],
)
def test_what_needs_more_names_the_extra(program: str, needed_by: str, remedy: str) -> None:
    done = run(program, PROJECT["dependencies"])
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"service.errors.ExtraMissingError: {needed_by} needs the package ")
    assert last.endswith(remedy)


def test_arrays_without_their_encoders_name_the_remedy() -> None:
    for image, needed_by in (("rgb", "an rgb array"), ("depth", "depth_codec 'zstd'")):
        kept = {"rgb": "images = images[0], b'depth file'\n", "depth": "images = b'colour file', images[1]\n"}[image]
        done = run(ASK + ARRAYS + kept + "localize()", LEAST)
        assert f"ExtraMissingError: {needed_by} needs the package " in done.stderr.splitlines()[-1]


def test_the_command_line_without_its_packages_prints_one_line() -> None:
    module, _, function = PROJECT["scripts"]["streetfix"].partition(":")
    done = run(f"from {module} import {function} as main\nmain()", PROJECT["dependencies"])
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("streetfix: the command line needs the package 'typer'")
    assert line.endswith('pip install ".[server]"')


def test_the_server_and_everything_that_needs_it_bring_the_rest() -> None:
    extras = PROJECT["optional-dependencies"]
    with_server = {"server"}
    while (
        more := {
            name
            for name, needs in extras.items()
            if any(set(Requirement(each).extras) & with_server for each in needs if each.startswith("streetfix["))
        }
        - with_server
    ):
        with_server |= more
    assert set(extras) - with_server == {"grpc", "lz4"}
