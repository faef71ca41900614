"""The proto is lint-clean and says the same as the REST contract."""

import re
import subprocess
import sys
from pathlib import Path

from service.contract import schema

PROTO = Path(__file__).parents[2] / "proto"
BUF = Path(sys.executable).parent / "buf"


def fields_of(message: str) -> set[str]:
    text = (PROTO / "streetfix" / "v1" / "localization.proto").read_text()
    body = re.search(rf"^message {message} {{(.*?)^}}", text, flags=re.MULTILINE | re.DOTALL)
    assert body is not None
    return set(re.findall(r"^ +(?:optional |repeated )?(?:\w+|map<[^>]+>) (\w+) = \d+;", body[1], flags=re.MULTILINE))


def test_the_proto_is_lint_clean(tmp_path: Path) -> None:
    done = subprocess.run(
        [BUF, "lint"], cwd=PROTO, env={"BUF_CACHE_DIR": str(tmp_path), "PATH": ""}, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_the_proto_is_formatted(tmp_path: Path) -> None:
    done = subprocess.run(
        [BUF, "format", "--diff"],
        cwd=PROTO,
        env={"BUF_CACHE_DIR": str(tmp_path), "PATH": ""},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, b"")


def test_messages_have_the_fields_of_the_rest_contract() -> None:
    same = [
        "Camera",
        "Options",
        "Street",
        "Pose",
        "Neighbour",
        "MapVersion",
        "RigidTransform",
        "Prior",
        "PriorPosition",
        "PriorWgs84",
    ]
    for name in same:
        assert fields_of(name) == set(getattr(schema, name).model_fields), name
    assert fields_of("Hypothesis") == set(schema.HypothesisOfPose.model_fields)


def test_the_answer_has_the_fields_of_the_rest_contract() -> None:
    expected = {"timings" if name == "timings_ms" else name for name in schema.LocalizeAnswer.model_fields}
    assert fields_of("LocalizeResponse") == expected


def test_the_request_has_the_fields_of_the_rest_contract() -> None:
    renamed = {"depth": "depth_format", "T_vehicle_camera": "vehicle_from_camera"}
    expected = {renamed.get(name, name) for name in schema.LocalizeRequest.model_fields}
    assert fields_of("LocalizeRequest") == expected | {"rgb", "depth"}
    assert fields_of("DepthFormat") == set(schema.Depth.model_fields)


def test_the_generated_code_is_that_of_the_proto(tmp_path: Path) -> None:
    folder = "service/grpc/generated"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "grpc_tools.protoc",
            "-I",
            f"{folder}={PROTO}",
            f"--python_out={tmp_path}",
            f"--pyi_out={tmp_path}",
            f"--grpc_python_out={tmp_path}",
            f"{folder}/streetfix/v1/localization.proto",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    made = sorted((tmp_path / folder / "streetfix" / "v1").iterdir())
    assert len(made) == 3
    for path in made:
        committed = PROTO.parent / path.relative_to(tmp_path)
        assert committed.read_text() == path.read_text(), "make generate"
