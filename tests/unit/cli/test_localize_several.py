"""``streetfix localize --sequence`` and ``--batch``: the files, the requests, and the answers of a real service."""

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn

from service.cli.main import main
from service.cli.pair_files import read_sequence
from service.client import Client, Frame
from service.contract.schema import LocalizeAnswer, Options, SequenceRequest
from service.errors import RequestError
from service.geometry.rigid import inverse, quaternion_xyzw_from, rotation_y, rotation_z, transform_from
from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.settings import Settings

CAMERA = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}
SHARED = {"camera": CAMERA, "depth": {"scale_m": 1, "kind": "z"}}
PAIR = {"rgb_file": "images/rgb.png", "depth_file": "images/depth.npy"}
SAME = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}


@pytest.fixture(scope="module")
def url(bundle_path: Path) -> Iterator[str]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    server = uvicorn.Server(uvicorn.Config(create_app(engine), port=0, log_config=None, lifespan="off"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()
    engine.close()


@pytest.fixture
def write(tmp_path: Path, parts_of: Any) -> Callable[..., str]:
    """Write a file beside a folder with the images and return its path. One image has no depth."""
    folder = tmp_path / "images"
    folder.mkdir()
    parts = parts_of()
    (folder / "rgb.png").write_bytes(parts["rgb"])
    (folder / "depth.npy").write_bytes(parts["depth"])
    np.save(folder / "blind.npy", np.zeros((48, 64), np.float32))

    def written(document: Any, name: str = "pairs.json") -> str:
        path = tmp_path / name
        path.write_text(document if isinstance(document, str) else json.dumps(document))
        return str(path)

    return written


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return the exit code and the output of the command."""

    def ran(*arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main(["localize", *arguments])
        captured = capsys.readouterr()
        return int(end.value.code or 0), captured.out, captured.err

    return ran


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[dict[str, Any]]]:
    """Answer each POST with the next response. The list collects paths and JSON."""

    def put(*responses: httpx.Response) -> list[dict[str, Any]]:
        posted: list[dict[str, Any]] = []

        def request(client: httpx.Client, method: str, path: str, **sent: Any) -> httpx.Response:
            posted.append(
                {"path": path, "parts": sorted(sent["files"]), "request": json.loads(sent["files"]["request"][1])}
            )
            response = responses[min(len(posted), len(responses)) - 1]
            response.request = httpx.Request(method, f"http://x{path}")
            return response

        monkeypatch.setattr(httpx.Client, "request", request)
        return posted

    return put


def answer_of(status: str = "LOCALIZED", **changed: Any) -> dict[str, Any]:
    pose = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {}, "heading_deg": 90.0, "covariance": None}
    return {
        "status": status,
        "confidence": 0.5,
        "pose": pose if status == "LOCALIZED" else None,
        "street": {"name": "Street 1"},
        "hypotheses": [{"pose": pose, "share": 1.0, "inliers": 0.5, "similarity": 0.5}],
    } | changed


def untimed(answer: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in answer.items() if name not in ("timings_ms", "focal_length_factor")}


def test_a_sequence_gets_the_answer_that_the_client_gets(url: str, write: Any, run: Any, pictures: Any) -> None:
    rgb, depth_m, camera = pictures
    with Client(url, quality=None) as client:
        frames = [
            Frame(rgb=rgb, depth=depth_m, camera=camera),
            Frame(rgb=rgb, depth=depth_m, camera=camera, T_reference_camera=np.eye(4)),
        ]
        expected = client.localize_sequence(frames, options=Options(neighbours=3))
    path = write(SHARED | {"frames": [PAIR, PAIR | {"T_reference_camera": SAME}], "options": {"neighbours": 3}})
    code, out, err = run("--url", url, "--sequence", path, "--json", "--no-try-focal")
    answer = LocalizeAnswer.model_validate_json(out)
    assert code == (0 if answer.status == "LOCALIZED" else 3)
    assert err == ""
    assert (answer.status, answer.confidence) == (expected.status, expected.confidence)
    assert [each.place for each in answer.neighbours] == [each.place for each in expected.neighbours]
    assert len(answer.neighbours) == 3
    code_of_text, text, _ = run("--url", url, "--sequence", path, "--no-try-focal")
    assert code_of_text == code
    assert text.startswith("status ")
    assert answer.status in text


def test_a_camera_of_a_frame_replaces_the_one_of_all(url: str, write: Any, run: Any) -> None:
    own = SHARED | {
        "camera": CAMERA | {"fx": 1},
        "frames": [PAIR | SHARED, PAIR | SHARED | {"T_reference_camera": SAME}],
    }
    shared = SHARED | {"frames": [PAIR, PAIR | {"T_reference_camera": SAME}]}
    answers = [
        run("--url", url, "--sequence", write(document, f"{number}.json"), "--json", "--no-try-focal")[1]
        for number, document in enumerate((own, shared))
    ]
    assert untimed(json.loads(answers[0])) == untimed(json.loads(answers[1]))


def rigid_json(T: Any) -> dict[str, Any]:
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion_xyzw_from(T[:3, :3]).tolist(), strict=True)),
    }


def test_odometry_of_all_frames_becomes_the_pose_in_the_first_camera(write: Any) -> None:
    first = transform_from(rotation_z(0.3) @ rotation_y(-0.4), np.array([431_000.0, 5_412_000.0, 210.0]))
    step = transform_from(rotation_y(0.1), np.array([0.2, -0.1, 1.5]))
    frames = [PAIR | {"T_odometry_camera": rigid_json(T)} for T in (first, first @ step)]
    sequence = read_sequence(Path(write(SHARED | {"frames": frames, "map": "tiny"})))
    requests = [pair.request for pair in sequence.pairs]
    assert "T_reference_camera" not in requests[0]
    found = requests[1]["T_reference_camera"]
    np.testing.assert_allclose([found["position"][axis] for axis in "xyz"], step[:3, 3], atol=1e-6)
    np.testing.assert_allclose(
        [found["orientation"][axis] for axis in "xyzw"], quaternion_xyzw_from(step[:3, :3]), atol=1e-9
    )
    SequenceRequest.model_validate(sequence.about | {"frames": requests})
    np.testing.assert_allclose(inverse(first) @ (first @ step), step, atol=1e-6)


def test_a_batch_is_sent_in_parts_with_progress_and_a_refused_pair_has_its_number(
    url: str, write: Any, run: Any
) -> None:
    requests = [PAIR] * 9 + [PAIR | {"depth_file": "images/blind.npy"}]
    path = write(SHARED | {"requests": requests, "options": {"refine": False}})
    code, out, err = run("--url", url, "--batch", path, "--json")
    outcomes = json.loads(out)["outcomes"]
    assert code == 1
    assert [each["answer"] is None for each in outcomes] == [False] * 9 + [True]
    assert all(untimed(each["answer"]) == untimed(outcomes[0]["answer"]) for each in outcomes[:9])
    assert (outcomes[9]["problem"]["code"], outcomes[9]["problem"]["field"]) == ("no-depth", "requests.9.depth")
    assert err == "streetfix: 8 of 10 pairs answered\nstreetfix: 10 of 10 pairs answered\n"
    code, out, _ = run("--url", url, "--batch", path)
    assert code == 1
    text = " ".join(out.split())
    assert "refused" in text
    assert "[field requests.9.depth]" in text
    localized = sum(each["answer"]["status"] == "LOCALIZED" for each in outcomes[:9])
    assert f"{localized} of 10 pairs LOCALIZED, 1 refused" in text


@pytest.mark.parametrize(("statuses", "code"), [(["LOCALIZED", "LOCALIZED"], 0), (["LOCALIZED", "AMBIGUOUS"], 3)])
def test_the_exit_code_of_a_batch_says_whether_all_have_a_pose(
    write: Any, run: Any, answering: Any, statuses: list[str], code: int
) -> None:
    outcomes = [{"answer": answer_of(status), "problem": None} for status in statuses]
    answering(httpx.Response(200, json={"outcomes": outcomes}))
    path = write(SHARED | {"requests": [PAIR, PAIR]})
    for flags in ([], ["--json"]):
        assert run("--batch", path, *flags)[0] == code
    assert json.loads(run("--batch", path, "--json")[1]) == {"outcomes": outcomes}


def test_options_hold_for_all_pairs_of_a_file(write: Any, run: Any, answering: Any) -> None:
    flags = ["--map", "b", "--near", "1,2", "--camera-height", "0.3"]
    prior, camera = {"position": {"x": 1.0, "y": 2.0}}, CAMERA | {"height_m": 0.3}
    posted = answering(httpx.Response(200, json={"outcomes": [{"answer": answer_of(), "problem": None}] * 2}))
    assert run("--batch", write(SHARED | {"map": "a", "requests": [PAIR, PAIR | {"map": "c"}]}), *flags)[0] == 0
    assert posted[0]["path"] == "/v1/localize/batch"
    assert posted[0]["parts"] == ["depth0", "depth1", "request", "rgb0", "rgb1"]
    expected = {"camera": camera, "depth": SHARED["depth"], "map": "b", "prior": prior}
    assert posted[0]["request"] == {"requests": [expected, expected]}
    posted = answering(httpx.Response(200, json=answer_of()))
    frames = [PAIR, PAIR | {"T_reference_camera": SAME}]
    assert run("--sequence", write(SHARED | {"map": "a", "frames": frames}), "--json", *flags)[0] == 0
    frame = {"camera": camera, "depth": SHARED["depth"]}
    assert posted[0]["path"] == "/v1/localize/sequence"
    assert posted[0]["request"] == {"map": "b", "prior": prior, "frames": [frame, frame | {"T_reference_camera": SAME}]}


def test_other_focal_lengths_are_tried_for_a_sequence(write: Any, run: Any, answering: Any) -> None:
    refused = answer_of("AMBIGUOUS")
    posted = answering(*(httpx.Response(200, json=answer) for answer in (refused, answer_of(), refused)))
    code, out, _ = run("--sequence", write(SHARED | {"frames": [PAIR, PAIR | {"T_reference_camera": SAME}]}), "--json")
    assert code == 3
    assert json.loads(out)["focal_length_factor"] is None  # no support is gained
    assert [[frame["camera"]["fx"] for frame in each["request"]["frames"]] for each in posted] == [
        [32, 32],
        [16, 16],
        [64, 64],
    ]


def test_answers_before_a_refusal_are_printed(write: Any, run: Any, answering: Any) -> None:
    outcome = {"answer": answer_of(), "problem": None}
    problem = {"title": "Not allowed.", "detail": "the key has expired", "code": "unauthorized"}
    path = write(SHARED | {"requests": [PAIR] * 9})
    answering(httpx.Response(200, json={"outcomes": [outcome] * 8}), httpx.Response(401, json=problem))
    code, out, err = run("--batch", path, "--json")
    assert code == 1
    assert json.loads(out) == {"outcomes": [outcome] * 8}
    assert err.startswith(
        "streetfix: 8 of 9 pairs answered\nstreetfix: the service refused: Not allowed.\n  the key has expired"
    )


@pytest.mark.parametrize("option", ["sequence", "batch"])
def test_a_field_that_the_service_refuses_is_named_with_its_file(url: str, write: Any, run: Any, option: str) -> None:
    """The number is that of the file, also in the second request of a batch."""
    name, number = ("frames", 1) if option == "sequence" else ("requests", 9)
    wrong = PAIR | {"camera": CAMERA | {"fx": -1}} | ({"T_reference_camera": SAME} if option == "sequence" else {})
    path = write(SHARED | {name: [PAIR] * number + [wrong]})
    code, _, err = run("--url", url, f"--{option}", path)
    assert code == 1
    assert f"streetfix: {path}: the service refused: " in err
    assert f"{name}.{number}.camera.fx" in err
    assert (f"{name}.1.camera.fx" in err) == (number == 1)


MOVED = {"T_odometry_camera": SAME}


@pytest.mark.parametrize("option", ["sequence", "batch"])
@pytest.mark.parametrize(
    ("document", "told"),
    [
        ("{", "pairs.json: not valid JSON"),
        ("[]", "pairs.json: expected a JSON object"),
        ({}, "pairs.json: NAME: expected a list"),
        ({"NAME": []}, "pairs.json: NAME: expected a list"),
        ({"NAME": {}}, "pairs.json: NAME: expected a list"),
        (SHARED | {"NAME": [PAIR, 3]}, "pairs.json: NAME.1: expected an object"),
        (SHARED | {"NAME": [PAIR, {"depth_file": "d"}]}, "pairs.json: NAME.1.rgb_file is missing"),
        (SHARED | {"NAME": [{"rgb_file": "r", "depth_file": 3}]}, "pairs.json: NAME.0.depth_file is missing"),
        ({"NAME": [PAIR]}, "pairs.json: NAME.0.camera is missing"),
        (SHARED | {"NAME": [PAIR, PAIR | {"rgb_file": "no.png"}]}, "pairs.json: NAME.1.rgb_file: "),
        (SHARED | {"NAME": [PAIR | {"depth_file": "no.png"}]}, "no.png cannot be read (No such file or directory)"),
    ],
)
def test_a_file_that_is_incomplete_is_refused_by_field_and_nothing_is_sent(
    write: Any, run: Any, answering: Any, option: str, document: Any, told: str
) -> None:
    posted = answering(httpx.Response(500))
    name = "frames" if option == "sequence" else "requests"
    text = document if isinstance(document, str) else json.dumps(document)
    code, _, err = run(f"--{option}", write(text.replace("NAME", name)))
    assert code == 1
    assert told.replace("NAME", name) in err
    assert posted == []


@pytest.mark.parametrize(
    ("frames", "told"),
    [
        ([PAIR | MOVED, PAIR], "frames.1.T_odometry_camera is missing, but other frames have it"),
        (
            [PAIR | MOVED, PAIR | MOVED | {"T_reference_camera": SAME}],
            "frames.1.T_odometry_camera and T_reference_camera",
        ),
        ([PAIR | {"T_odometry_camera": 3}], "frames.0.T_odometry_camera: expected position"),
        (
            [PAIR | {"T_odometry_camera": SAME | {"position": {"x": 1, "y": 2}}}],
            "frames.0.T_odometry_camera: expected pos",
        ),
        ([PAIR | {"T_odometry_camera": SAME | {"position": {"x": 1e999, "y": 2, "z": 3}}}], "expected finite numbers"),
        ([PAIR | {"T_odometry_camera": SAME | {"orientation": dict.fromkeys("xyzw", 0)}}], "and a unit quaternion"),
    ],
)
def test_odometry_that_is_incomplete_is_refused_by_field(write: Any, frames: Any, told: str) -> None:
    path = write(SHARED | {"frames": frames})
    with pytest.raises(RequestError) as caught:
        read_sequence(Path(path))
    assert caught.value.message.startswith(f"{path}: frames.")
    assert told in caught.value.message
    assert caught.value.field.endswith("T_odometry_camera")


def test_a_file_that_is_missing_is_named_with_its_option(run: Any, tmp_path: Path) -> None:
    code, _, err = run("--batch", str(tmp_path / "no.json"))
    assert code == 1
    assert "no.json: cannot be read (No such file or directory); check --batch" in err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            [],
            "missing --rgb, --depth, --camera (every query needs a depth image of the same moment); or give --sequence",
        ),
        (["--rgb", "a", "--camera", "c"], "missing --depth (every query needs a depth image"),
        (["--sequence", "a", "--batch", "b"], "--sequence and --batch exclude each other"),
        (["--sequence", "a", "--rgb", "b"], "--rgb and --sequence exclude each other"),
        (["--batch", "a", "--camera", "b"], "--camera and --batch exclude each other"),
        (["--batch", "a", "--try-focal"], "--try-focal and --batch exclude each other"),
    ],
)
def test_options_that_do_not_belong_together_are_wrong_usage(run: Any, arguments: list[str], told: str) -> None:
    code, _, err = run(*arguments)
    assert code == 2
    assert told in " ".join(err.split())


def test_something_else_at_the_address_is_not_taken_for_outcomes(write: Any, run: Any, answering: Any) -> None:
    path = write(SHARED | {"requests": [PAIR]})
    for content in (
        [],
        {},
        {"outcomes": []},
        {"outcomes": [3]},
        {"outcomes": [{"answer": None}]},
        {"outcomes": [{"answer": {}}]},
    ):
        answering(httpx.Response(200, json=content))
        code, _, err = run("--batch", path)
        assert code == 1
        assert "Streetfix" in err


def test_the_table_of_a_batch_names_images_and_streets_in_whole_words(write: Any, run: Any, answering: Any) -> None:
    street = {"name": "Beginning of the street [east] with a long name"}
    problem = {"title": "Too few.", "detail": "no depth", "field": "requests.1.depth"}
    outcomes = [
        {"answer": answer_of(street=street), "problem": None},
        {"answer": None, "problem": problem},
        {"answer": answer_of("OUT_OF_MAP", confidence=None), "problem": None},
    ]
    answering(httpx.Response(200, json={"outcomes": outcomes}))
    code, out, _ = run("--batch", write(SHARED | {"requests": [PAIR] * 3}))
    rows = [line.split() for line in out.splitlines()]
    assert code == 1
    assert " ".join(rows[1]) == f"0 rgb.png LOCALIZED 0.500 {street['name']} x 1.00 y 2.00 z 3.00 m 90.0"
    assert rows[2] == ["1", "rgb.png", "refused"]
    assert rows[3] == ["2", "rgb.png", "OUT_OF_MAP"]
    assert out.splitlines()[4:] == [
        "pair 1 (rgb.png): Too few. no depth [field requests.1.depth]",
        "1 of 3 pairs LOCALIZED, 1 refused",
    ]


def reasons_of(*checks: str) -> list[dict[str, Any]]:
    return [{"check": check, "evidence": {}, "remedy": f"remedy of {check}"} for check in checks]


def test_a_batch_of_few_poses_says_what_to_check_the_most_frequent_reason_first(
    write: Any, run: Any, answering: Any
) -> None:
    """Equally frequent reasons are in the order of a single answer: intrinsics before baseline."""
    reasons = [("baseline", "calibration"), ("calibration",), ("intrinsics", "calibration"), ()]
    outcomes = [{"answer": answer_of("AMBIGUOUS", reasons=reasons_of(*each)), "problem": None} for each in reasons]
    answering(httpx.Response(200, json={"outcomes": outcomes}))
    code, out, _ = run("--batch", write(SHARED | {"requests": [PAIR] * 4}))
    assert code == 3
    assert out.splitlines()[5:] == [
        "0 of 4 pairs LOCALIZED, 0 refused",
        "why 4 answers may not be LOCALIZED, the most frequent reason first",
        "  1. calibration (3 of 4): remedy of calibration",
        "  2. intrinsics (1 of 4): remedy of intrinsics",
        "  3. baseline (1 of 4): remedy of baseline",
        (
            "  1 of 4 answers: all confidence features are in the range of the calibration data. The place may be outside the map or a "
            "perceptual alias."
        ),
    ]


@pytest.mark.parametrize(("localized", "is_told"), [(0, True), (1, False)])
def test_a_batch_with_a_quarter_of_poses_gives_no_reasons(
    write: Any, run: Any, answering: Any, localized: int, is_told: bool
) -> None:
    statuses = ["LOCALIZED"] * localized + ["AMBIGUOUS"] * (4 - localized)
    outcomes = [{"answer": answer_of(status, reasons=reasons_of("baseline")), "problem": None} for status in statuses]
    answering(httpx.Response(200, json={"outcomes": outcomes}))
    assert ("remedy of baseline" in run("--batch", write(SHARED | {"requests": [PAIR] * 4}))[1]) == is_told


def test_a_service_without_reasons_is_named_in_a_batch(write: Any, run: Any, answering: Any) -> None:
    answering(httpx.Response(200, json={"outcomes": [{"answer": answer_of("AMBIGUOUS"), "problem": None}]}))
    assert run("--batch", write(SHARED | {"requests": [PAIR]}))[1].endswith("The service gives no reasons.\n")
