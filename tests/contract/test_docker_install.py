"""There may be no container engine where this runs: the Dockerfile's own install steps run in a clean environment."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MOST_BYTES = 700 * 2**20
#: As .dockerignore has them.
IGNORED = ("__pycache__", "*.so", "node_modules", "web", "CMakeFiles", "CMakeCache.txt")


def instructions() -> list[list[tuple[str, str]]]:
    """Instruction and arguments of each stage."""
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines))
    stages: list[list[tuple[str, str]]] = []
    for line in joined.splitlines():
        name, _, rest = line.partition(" ")
        if name == "FROM":
            stages.append([])
        if name:
            stages[-1].append((name, rest.strip()))
    return stages


def run(command: list[str], cwd: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run without anything of the environment that the tests run in."""
    kept = {"HOME": str(cwd.parent), "PATH": "/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        command,
        cwd=cwd,
        env=kept | environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of the build: this Python and its pip, with the user's settings of the registry.

    Skips where no package can be had.
    """
    folder = tmp_path_factory.mktemp("registry")
    environment = dict(os.environ) | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    environment.pop("PIP_REQUIRE_VIRTUALENV", None)
    asked = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--retries",
        "1",
        "--timeout",
        "10",
        "scikit-build-core",
    ]
    reached = subprocess.run(
        asked, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    if reached.returncode != 0:
        pytest.skip("the package registry cannot be reached, so the image's install steps cannot be tried")
    return environment


@pytest.fixture(scope="module")
def installed(tools: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``/opt/streetfix`` of the image, made by the first stage's own COPY and RUN."""
    place = tmp_path_factory.mktemp("image")
    source, wheels, target = place / "src", place / "wheels", place / "streetfix"
    source.mkdir()
    for name, rest in instructions()[0]:
        if name == "COPY":
            *froms, to = shlex.split(rest)
            for each in froms:
                destination = source / to / Path(each).name if to.endswith("/") else source / to
                destination.parent.mkdir(parents=True, exist_ok=True)
                if (ROOT / each).is_dir():
                    shutil.copytree(ROOT / each, destination, ignore=shutil.ignore_patterns(*IGNORED))
                else:
                    shutil.copy(ROOT / each, destination)
        elif name == "RUN":
            # Packages may come from pip's cache here; nothing else differs from the image.
            step = rest.replace("--no-cache-dir ", "").replace("/opt/", f"{place}/").replace("/wheels", str(wheels))
            done = subprocess.run(
                ["bash", "-euc", step], cwd=source, env=tools, capture_output=True, text=True, check=False, timeout=600
            )
            assert done.returncode == 0, f"{step}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    shutil.rmtree(source)
    return target


def test_the_command_is_there_and_the_size_is_known(
    installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = run([str(installed / "bin" / "streetfix"), "--help"], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "serve" in done.stdout
    size = sum(path.lstat().st_size for path in installed.rglob("*") if path.is_file())
    with capsys.disabled():
        print(f"\n  the service with all its packages: {size / 2**20:.0f} MiB")  # noqa: T201
    assert size < MOST_BYTES


@pytest.mark.parametrize(
    "package", ["model_training", "torch", "embreex", "scipy", "pip", "setuptools", "pytest", "ziglang", "cmake"]
)
def test_what_the_service_does_not_need_is_not_there(installed: Path, tmp_path: Path, package: str) -> None:
    done = run([str(installed / "bin" / "python"), "-c", f"import {package}"], tmp_path)
    assert f"No module named '{package}'" in done.stderr


def test_no_encoder_and_no_source_of_c_is_there(installed: Path) -> None:
    """The only network is the verifier: it belongs to the program, the encoder to the map."""
    found = [
        path for pattern in ("*.onnx", "*.c", "*.h") for path in (installed / "lib").glob(f"*/*/service/**/{pattern}")
    ]
    assert [path.name for path in found] == ["verifier.onnx"]
    assert len(list((installed / "lib").glob("*/*/service/*/_*.so"))) == len(list((ROOT / "service").rglob("*.c")))


def test_commands_that_are_not_there_are_not_listed(installed: Path, tmp_path: Path) -> None:
    told = run([str(installed / "bin" / "streetfix"), "--help"], tmp_path).stdout
    listed = re.findall(r"^  ([a-z-]+)  ", told.partition("Commands:")[2], re.MULTILINE)
    assert sorted(listed) == ["bridge", "doctor", "health", "keys", "localize", "serve"]


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["simulate", "--out", "city"], "mapping"),
        (["demo", "--once"], "mapping"),
        (["map", "info", "city"], "mapping"),
        (["train", "--run", "run"], "training"),
        (["export", "run", "--out", "encoder.onnx"], "training"),
    ],
)
def test_a_command_that_is_not_there_says_what_to_install(
    installed: Path, tmp_path: Path, arguments: list[str], extra: str
) -> None:
    done = run([str(installed / "bin" / "streetfix"), *arguments], tmp_path)
    assert done.returncode == 1
    assert f"the command '{arguments[0]}' is not part of this installation" in done.stderr
    assert f'pip install ".[{extra}]"' in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.fixture
def port(installed: Path, bundle_path: Path, tmp_path: Path) -> Iterator[str]:
    """Where the service tells its health; it is started as the image starts it but on loopback."""
    process = subprocess.Popen(
        [installed / "bin" / "streetfix", "serve", "--host", "127.0.0.1"],
        cwd=tmp_path,
        env={
            "PATH": "/usr/bin:/bin",
            "STREETFIX_MAPS": str(bundle_path),
            "STREETFIX_PORT": "0",
            "STREETFIX_HEALTH_PORT": "0",
        },
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        lines = iter(process.stdout or ())
        health = next(found[1] for line in lines if (found := re.search(r"health at http://127.0.0.1:(\d+)", line)))
        next(line for line in lines if "serving at" in line)
        yield health
    finally:
        process.terminate()
        process.communicate(timeout=60)


def test_it_serves_a_mounted_map_and_the_health_check_says_so(installed: Path, tmp_path: Path, port: str) -> None:
    health = next(rest for name, rest in instructions()[-1] if name == "HEALTHCHECK")
    program, *arguments = json.loads(health[health.index("CMD ") + 4 :])
    command = [str(installed / "bin" / program), *arguments]
    done = run(command, tmp_path, STREETFIX_HEALTH_PORT=port)
    assert (done.returncode, done.stderr) == (0, "")
    everywhere = run(command, tmp_path, STREETFIX_HEALTH_PORT=port, STREETFIX_HOST="0.0.0.0")  # noqa: S104
    assert (everywhere.returncode, everywhere.stderr) == (0, "")
    assert run(command, tmp_path, STREETFIX_HEALTH_PORT="1").returncode != 0


def test_the_images_environment_keeps_onnx_runtime_from_reporting_usage(installed: Path, tmp_path: Path) -> None:
    # Left alone it keeps a device id and a queue of events in the home folder, and sends them.
    (tmp_path / "work").mkdir()
    words = [word for name, rest in instructions()[-1] if name == "ENV" for word in shlex.split(rest)]
    wanted = dict(word.split("=", 1) for word in words if word.startswith("ORT_"))
    done = run([str(installed / "bin" / "python"), "-c", "import onnxruntime"], tmp_path / "work", **wanted)
    assert (done.returncode, done.stderr) == (0, "")
    assert [path.name for path in tmp_path.rglob("*")] == ["work"]
