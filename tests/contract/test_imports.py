"""What ``streetfix serve`` loads is the service alone, and asking for help loads next to nothing."""

import subprocess
import sys
from pathlib import Path

import pytest

import service


def loaded_by(program: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after a program."""
    report = "\nimport sys; print(' '.join(sorted({name.split('.')[0] for name in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", program + report], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_serving_loads_neither_torch_nor_model_training() -> None:
    program = (
        "import uvicorn, service.cli.main, service.cli.serve, service.cli.localize, service.cli.answer_text\n"
        "import service.http.app, service.runtime.engine, service.runtime.settings, service.runtime.threads\n"
        "import service.cli.certificates, service.grpc.server"
    )
    unwanted = {"torch", "model_training", "embreex", "scipy", "shapely", "onnx", "matplotlib", "httpx"}
    assert loaded_by(program) & unwanted == set()


def test_no_file_of_the_service_names_model_training() -> None:
    """The import contract sees statements, also in functions; an import by a name in a string it would not see."""
    files = sorted(Path(service.__file__).parent.rglob("*.py"))
    assert [str(path) for path in files if "model_training" in path.read_text()] == []


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["serve", "--help"], ["localize", "--help"]])
def test_asking_for_help_loads_no_numeric_library(arguments: list[str]) -> None:
    program = (
        "from service.cli.main import main\n"
        f"try: main({arguments!r})\n"
        "except SystemExit as end: assert not end.code, end.code"
    )
    heavy = {"numpy", "cv2", "faiss", "onnxruntime", "fastapi", "uvicorn", "httpx", "model_training"}
    assert loaded_by(program) & heavy == set()
