import io
import json
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.console import Console

from service.cli.answer_text import print_answer
from service.cli.main import main
from service.cli.send import localize
from service.contract.schema import Prior
from service.errors import RefusedError, RequestError, UnreachableError

ANSWER: dict[str, Any] = {
    "status": "LOCALIZED",
    "confidence": None,
    "street": {"id": "s2", "name": "End of street 4", "street": "4", "section": "end", "class_index": 6, "vote": 0.8},
    "pose": {"position": {"x": 1.234, "y": 5, "z": 1.5}, "orientation": {}, "heading_deg": 90.4, "covariance": None},
    "vehicle_pose": None,
    "geopose": None,
    "hypotheses": [
        {
            "confirmed": True,
            "pose": {
                "position": {"x": 1.234, "y": 5, "z": 1.5},
                "orientation": {},
                "heading_deg": 90.4,
                "covariance": None,
            },
            "share": 0.625,
            "inliers": 0.5,
            "similarity": 0.9,
        },
        {
            "confirmed": False,
            "pose": {
                "position": {"x": 77, "y": -88, "z": 1.5},
                "orientation": {},
                "heading_deg": -89.6,
                "covariance": None,
            },
            "share": 0.375,
            "inliers": 0.25,
            "similarity": 0.875,
        },
    ],
    "spread": None,
    "reasons": [],
    "neighbours": [
        {
            "place": 8,
            "distance": 0.1,
            "similarity": 0.995,
            "street": None,
            "position": {"x": 1, "y": 2, "z": 3},
            "heading_deg": 90.0,
        },
    ],
    "map": {"name": "tiny", "version": "0123456789abcdef"},
    "timings_ms": {"decode": 1.0, "total": 2.0},
}


#: What a refused answer has in their place.
REFUSED: dict[str, Any] = {
    "status": "AMBIGUOUS",
    "confidence": 0.3,
    "pose": None,
    "street": None,
    "hypotheses": [each | {"confirmed": False} for each in ANSWER["hypotheses"]],
    "spread": {
        "mean": {"x": 35, "y": -40, "z": 1.5},
        "covariance": [9.0, 0, 0, 0, 2025.0, 0, 0, 0, 1.0],
        "heading_std_deg": 70.0,
        "hypotheses_weight": 0.6,
    },
    "reasons": [
        {"check": "baseline", "evidence": {"log_noise": 4.25, "points": -3.5}, "remedy": "check the stereo baseline"},
        {"check": "depth", "evidence": {}, "remedy": "check [depth.scale_m]"},
    ],
}


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Any]:
    for name, data in {"rgb": b"r", "depth": b"d", "camera": b'{"camera": {}, "map": "a"}'}.items():
        (tmp_path / name).write_bytes(data)
    return {name: tmp_path / name for name in ("rgb", "depth", "camera")}


@pytest.fixture
def given(files: dict[str, Any]) -> list[str]:
    """Return the command-line options of the same values. The camera has a focal length."""
    files["camera"].write_text('{"camera": {"fx": 32, "fy": 30, "cx": 31.5}}')
    return [part for name, path in files.items() for part in (f"--{name}", str(path))]


@pytest.fixture
def by_focal(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[dict[str, Any]]]:
    """Answer by the fx of the request. The list collects the cameras."""

    def put(answers: dict[float, tuple[int, dict[str, Any]]]) -> list[dict[str, Any]]:
        asked: list[dict[str, Any]] = []

        def request(client: httpx.Client, method: str, path: str, **sent: Any) -> httpx.Response:
            camera = json.loads(sent["files"]["request"][1])["camera"]
            asked.append(camera)
            status, content = answers[camera["fx"]]
            return httpx.Response(status, json=content, request=httpx.Request(method, f"http://x{path}"))

        monkeypatch.setattr(httpx.Client, "request", request)
        return asked

    return put


def refused_with(*, inliers: float = 0.5, similarity: float = 0.5) -> dict[str, Any]:
    best = REFUSED["hypotheses"][0] | {"inliers": inliers, "similarity": similarity}
    return ANSWER | REFUSED | {"hypotheses": [best, REFUSED["hypotheses"][1]]}


def localized_with(*, similarity: float) -> dict[str, Any]:
    return ANSWER | {"hypotheses": [ANSWER["hypotheses"][0] | {"similarity": similarity}]}


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["localize", *arguments])
    return int(end.value.code or 0)


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[httpx.Response], list[dict[str, Any]]]:
    """Answer every POST with a response. The list collects the requests."""

    def put(response: httpx.Response) -> list[dict[str, Any]]:
        posted: list[dict[str, Any]] = []

        def request(client: httpx.Client, method: str, path: str, **given: Any) -> httpx.Response:
            url = f"{str(client.base_url).rstrip('/')}{path}"
            posted.append({"method": method, "url": url} | given)
            response.request = httpx.Request(method, url)
            return response

        monkeypatch.setattr(httpx.Client, "request", request)
        return posted

    return put


def test_the_parts_are_posted_with_the_map_of_the_flag(files: dict[str, Any], answering: Callable[..., Any]) -> None:
    posted = answering(httpx.Response(200, json=ANSWER))
    assert localize("http://x:1/", **files, map_name="b") == ANSWER
    assert posted[0]["url"] == "http://x:1/v1/localize"
    assert json.loads(posted[0]["files"]["request"][1]) == {"camera": {}, "map": "b"}


def test_a_problem_is_reported_with_field_and_request_id(files: dict[str, Any], answering: Callable[..., Any]) -> None:
    problem = {"title": "T.", "detail": "what and why", "code": "request", "field": "camera.fx", "request_id": "r1"}
    answering(httpx.Response(422, json=problem))
    with pytest.raises(RefusedError) as caught:
        localize("http://x", **files)
    assert caught.value.message == "the service refused: T.\n  what and why [field camera.fx]\n  request id r1"


@pytest.mark.parametrize(
    "response", [httpx.Response(200, text="<html>"), httpx.Response(200, json=[]), httpx.Response(200, json={})]
)
def test_another_server_at_the_address_is_reported(
    files: dict[str, Any], answering: Callable[..., Any], response: httpx.Response
) -> None:
    answering(response)
    with pytest.raises(UnreachableError, match="not Streetfix"):
        localize("http://x", **files)


def test_an_unreachable_address_is_reported_with_the_remedy(files: dict[str, Any]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(UnreachableError, match="streetfix serve BUNDLE"):
        localize(f"http://127.0.0.1:{port}", **files)


@pytest.mark.parametrize("url", ["", "localhost:8000", "http://[", "ftp://x"])
def test_an_invalid_address_is_reported(files: dict[str, Any], url: str) -> None:
    with pytest.raises(RequestError, match="pass http://HOST:PORT"):
        localize(url, **files)


def test_a_file_that_is_missing_is_named(files: dict[str, Any]) -> None:
    files["depth"].unlink()
    with pytest.raises(RequestError, match=r"depth: cannot be read .*check --depth"):
        localize("http://x", **files)


@pytest.mark.parametrize(
    ("flags", "prior"),
    [
        (["--near", "12,-40"], {"position": {"x": 12.0, "y": -40.0}}),
        (["--near", "-12.5, 40, 3"], {"position": {"x": -12.5, "y": 40.0, "std_m": 3.0}}),
        (["--near=1e2,2e2"], {"position": {"x": 100.0, "y": 200.0}}),
        (["--heading", "-30"], {"heading_deg": -30.0}),
        (["--heading", "0", "--near", "0,0"], {"heading_deg": 0.0, "position": {"x": 0.0, "y": 0.0}}),
        ([], None),
    ],
)
def test_prior_knowledge_is_sent_as_in_the_contract(
    files: dict[str, Any], answering: Callable[..., Any], flags: list[str], prior: dict[str, Any] | None
) -> None:
    posted = answering(httpx.Response(200, json=ANSWER))
    given = [part for name, path in files.items() for part in (f"--{name}", str(path))]
    with pytest.raises(SystemExit) as end:
        main(["localize", *given, *flags])
    assert end.value.code in (0, None)
    request = json.loads(posted[0]["files"]["request"][1])
    assert request == {"camera": {}, "map": "a"} | ({} if prior is None else {"prior": prior})
    if prior is not None:
        Prior.model_validate(request["prior"])


def test_a_prior_of_the_flags_goes_above_the_files(files: dict[str, Any], answering: Callable[..., Any]) -> None:
    files["camera"].write_text('{"camera": {}, "prior": {"heading_deg": 5}}')
    posted = answering(httpx.Response(200, json=ANSWER))
    for prior in (None, {"position": {"x": 1.0, "y": 2.0}}):
        localize("http://x", **files, prior=prior)
    sent = [json.loads(each["files"]["request"][1])["prior"] for each in posted]
    assert sent == [{"heading_deg": 5}, {"position": {"x": 1.0, "y": 2.0}}]


@pytest.mark.parametrize("near", ["", "12", "12;40", "1,2,3,4", "here", "1,", ",", "12,-40,", "1,2m"])
def test_a_place_that_is_none_is_refused_with_an_example_and_nothing_is_sent(
    files: dict[str, Any], answering: Callable[..., Any], near: str, capsys: pytest.CaptureFixture[str]
) -> None:
    posted = answering(httpx.Response(200, json=ANSWER))
    given = [part for name, path in files.items() for part in (f"--{name}", str(path))]
    with pytest.raises(SystemExit) as end:
        main(["localize", *given, f"--near={near}"])
    assert end.value.code == 1
    error = capsys.readouterr().err
    assert error == f"streetfix: --near: {near!r} is not X,Y or X,Y,STD in metres, such as 12,-40,20\n"
    assert posted == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"fx": 1}'])
def test_a_camera_file_that_is_none_is_refused(files: dict[str, Any], text: str) -> None:
    files["camera"].write_text(text)
    with pytest.raises(RequestError, match="camera"):
        localize("http://x", **files)


def test_people_read_street_position_and_neighbours() -> None:
    stream = io.StringIO()
    print_answer(ANSWER, Console(file=stream, width=120))
    text = stream.getvalue()
    for wanted in (
        "LOCALIZED",
        "End of street 4 (80% of the votes)",
        "x 1.23  y 5.00  z 1.50 m",
        "90.4 degrees",
        "0.995",
    ):
        assert wanted in text


def text_of(**changed: Any) -> str:
    stream = io.StringIO()
    print_answer(ANSWER | changed, Console(file=stream, width=120))
    return stream.getvalue()


def test_people_read_how_sure_an_answer_is() -> None:
    assert "AMBIGUOUS (confidence 0.317)" in text_of(**REFUSED | {"confidence": 0.3171})
    assert "confidence" not in text_of()


@pytest.mark.parametrize("status", ["AMBIGUOUS", "OUT_OF_MAP"])
def test_people_read_where_else_it_may_be_when_it_is_not_sure(status: str) -> None:
    lines = text_of(**REFUSED | {"status": status}).splitlines()
    assert lines[0].split() == ["status", status, "(confidence", "0.300)"]
    assert lines[1].split() == ["pose", "none:", "the", "answer", "is", "not", "LOCALIZED"]
    assert "+- 45.0 m (one sigma)" in lines[2]
    start = next(k for k, line in enumerate(lines) if "where it may be (not confirmed)" in line)
    assert not any(line.startswith(("position", "heading", "street", "vehicle")) for line in lines)
    for wanted in (
        ("0.62", "0.50", "0.900", "x 1.23  y 5.00", "90"),
        ("0.38", "0.25", "0.875", "x 77.00  y -88.00", "-90"),
    ):
        assert any(all(part in line for part in wanted) for line in lines[start : start + 8]), wanted


def test_other_places_are_not_printed_if_the_answer_is_certain_or_there_are_none() -> None:
    assert "where it may be" not in text_of(confidence=0.999)
    assert "why" not in text_of(confidence=0.999)
    assert "where it may be" not in text_of(**REFUSED | {"hypotheses": []})


@pytest.mark.parametrize("flags", [[], ["--json"]])
@pytest.mark.parametrize(
    ("changed", "code"),
    [({}, 0), (REFUSED, 3), (REFUSED | {"status": "OUT_OF_MAP", "hypotheses": []}, 3)],
)
def test_the_exit_code_says_whether_there_is_a_pose(
    files: dict[str, Any],
    answering: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, Any],
    code: int,
    flags: list[str],
) -> None:
    answering(httpx.Response(200, json=ANSWER | changed))
    given = [part for name, path in files.items() for part in (f"--{name}", str(path))]
    assert run(*given, *flags, "--no-try-focal") == code
    told = capsys.readouterr().out
    if flags:
        assert json.loads(told) == ANSWER | changed
    else:
        assert told.split()[:2] == ["status", (ANSWER | changed)["status"]]


def test_people_read_why_and_what_to_do() -> None:
    lines = text_of(**REFUSED).splitlines()
    start = lines.index("why it may not be LOCALIZED, the likeliest cause first")
    told = " ".join(" ".join(lines[start + 1 : start + 4]).split())
    assert told.startswith(
        "1. baseline (standard deviations from the mean of the calibration data: log_noise +4.2, points -3.5): check the stereo baseline "
        "2. depth: check [depth.scale_m]"
    )


def test_people_read_that_all_evidence_is_in_range() -> None:
    told = " ".join(text_of(**REFUSED | {"reasons": []}).split())
    assert (
        "All confidence features are in the range of the calibration data. The place may be outside the map or a perceptual alias."
        in told
    )


def test_an_earlier_service_gives_no_reasons() -> None:
    answer = {name: value for name, value in (ANSWER | REFUSED).items() if name != "reasons"}
    stream = io.StringIO()
    print_answer(answer, Console(file=stream, width=120))
    assert "The service gives no reasons." in stream.getvalue()


@pytest.mark.parametrize(
    ("halved", "doubled", "factor"),
    [
        (refused_with(), refused_with(), None),
        (refused_with(inliers=0.79), refused_with(similarity=0.58), None),  # 5.8 and 5.44 nats more
        (refused_with(inliers=0.81), refused_with(), 0.5),  # 6.2
        (refused_with(), refused_with(similarity=0.59), 2.0),  # 6.12
        (refused_with(inliers=0.85), refused_with(inliers=0.95), 2.0),
        (ANSWER, refused_with(inliers=1.0, similarity=1.0), 0.5),  # ANSWER has a similarity of 0.9
        (refused_with(inliers=0.0, similarity=0.0), ANSWER, 2.0),
        (localized_with(similarity=0.51), refused_with(), 0.5),
        (localized_with(similarity=0.49), refused_with(), None),
        (ANSWER | REFUSED | {"hypotheses": []}, refused_with(), None),
    ],
)
def test_a_focal_length_that_fits_the_map_clearly_better_is_named_first(
    given: list[str],
    by_focal: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    halved: dict[str, Any],
    doubled: dict[str, Any],
    factor: float | None,
) -> None:
    asked = by_focal({32: (200, refused_with()), 16: (200, halved), 64: (200, doubled)})
    assert run(*given, "--json") == 3
    assert json.loads(capsys.readouterr().out) == refused_with() | {"focal_length_factor": factor}
    assert asked == [{"fx": 32 * f, "fy": 30 * f, "cx": 31.5} for f in (1, 0.5, 2)]
    assert run(*given) == 3
    text = " ".join(capsys.readouterr().out.split())
    named = (
        f"1. the focal length is probably off by a factor of two: fx and fy times {factor or 0:g} fit the map better"
    )
    assert (named in text) == (factor is not None)
    assert f"{1 if factor is None else 2}. baseline" in text


@pytest.mark.parametrize(("answer", "flags"), [(ANSWER, []), (refused_with(), ["--no-try-focal"])])
def test_no_other_focal_length_is_tried_for_a_good_answer_or_where_that_is_switched_off(
    given: list[str],
    by_focal: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    answer: dict[str, Any],
    flags: list[str],
) -> None:
    asked = by_focal({32: (200, answer)})
    run(*given, "--json", *flags)
    assert json.loads(capsys.readouterr().out) == answer
    assert len(asked) == 1


def test_a_rejected_focal_length_is_reported_and_the_answer_stays(
    given: list[str], by_focal: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    problem = {"title": "Too few.", "detail": "no depth", "code": "no-depth"}
    by_focal({32: (200, refused_with()), 16: (422, problem), 64: (200, refused_with(inliers=0.9))})
    assert run(*given, "--json") == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out)["focal_length_factor"] == 2.0
    assert captured.err.startswith("streetfix: fx and fy times 0.5 could not be tried: the service refused: Too few.")


def test_an_older_services_answer_with_an_uncertain_pose_is_refused(
    files: dict[str, Any], answering: Callable[..., Any]
) -> None:
    answering(httpx.Response(200, json=ANSWER | {"status": "OUT_OF_MAP"}))
    with pytest.raises(UnreachableError, match="has another contract"):
        localize("http://x", **files)


def test_people_read_one_standard_deviation_of_position_and_heading() -> None:
    """The largest of 0.1, 0.3 and 0.2 m; 0.01 rad is 0.57 degrees."""
    covariance = [0.0] * 36
    covariance[0], covariance[7], covariance[14], covariance[35] = 0.01, 0.09, 0.04, 1e-4
    text = text_of(pose=ANSWER["pose"] | {"covariance": covariance})
    assert "+- 0.30 m (one sigma)" in text
    assert "+- 0.57 degrees (one sigma)" in text
    assert "sigma" not in text_of()


def test_a_folder_given_as_the_name_of_a_map_is_named(
    files: dict[str, Any], answering: Callable[..., Any], bundle_path: Path, tmp_path: Path
) -> None:
    problem = {"title": "T.", "detail": "there is no such map; mounted: tiny", "code": "unknown-map", "field": "map"}
    (dataset := tmp_path / "town").mkdir()
    (dataset / "dataset.json").write_text("{}")
    (other := tmp_path / "other").mkdir()
    answering(httpx.Response(404, json=problem))
    for folder, message in {
        bundle_path: f"{bundle_path} is the folder of a map bundle; give the name of the map: --map tiny",
        dataset: f"{dataset} is a dataset, not a map; give the name of a map of the service",
        other: f"{other} is a folder; give the name of a map of the service",
    }.items():
        with pytest.raises(RequestError) as caught:
            localize("http://x", **files, map_name=str(folder))
        assert caught.value.message == f"--map: {message}\n  there is no such map; mounted: tiny"
    with pytest.raises(RefusedError, match="there is no such map"):
        localize("http://x", **files, map_name="no-folder")


def test_a_folder_given_as_the_name_of_a_map_is_named_if_no_service_answers(
    files: dict[str, Any], bundle_path: Path
) -> None:
    with pytest.raises(RequestError) as caught:
        localize("http://127.0.0.1:1", **files, map_name=str(bundle_path))
    folder, service = caught.value.message.split("\n")
    assert folder == f"--map: {bundle_path} is the folder of a map bundle; give the name of the map: --map tiny"
    assert "no service answers" in service


@pytest.mark.parametrize(
    ("in_file", "given", "sent"),
    [
        ({"height_m": 0.4, "height_std_m": 0.1}, {}, {"height_m": 0.4, "height_std_m": 0.1}),
        ({}, {"camera_height_m": 0.3}, {"height_m": 0.3}),
        ({"height_m": 0.4, "height_std_m": 0.1}, {"camera_height_m": 0.3}, {"height_m": 0.3, "height_std_m": 0.1}),
        ({"height_m": 0.4}, {"camera_height_std_m": 0.02}, {"height_m": 0.4, "height_std_m": 0.02}),
    ],
)
def test_the_camera_height_of_the_options_overrides_the_file(
    files: dict[str, Any], answering: Callable[..., Any], in_file: Any, given: Any, sent: Any
) -> None:
    files["camera"].write_text(json.dumps({"camera": {"fx": 32} | in_file}))
    posted = answering(httpx.Response(200, json=ANSWER))
    localize("http://x", **files, **given)
    assert json.loads(posted[0]["files"]["request"][1])["camera"] == {"fx": 32} | sent


@pytest.mark.parametrize(
    ("in_file", "sent"),
    [
        ({}, {"false_accept_rate": 0.002}),
        ({"options": {"neighbours": 3, "false_accept_rate": 0.05}}, {"neighbours": 3, "false_accept_rate": 0.002}),
    ],
)
def test_a_false_accept_rate_overrides_that_of_the_file(
    given: list[str], files: dict[str, Any], answering: Callable[..., Any], in_file: Any, sent: Any
) -> None:
    files["camera"].write_text(json.dumps({"camera": {"fx": 32}} | in_file))
    posted = answering(httpx.Response(200, json=ANSWER))
    run(*given, "--false-accept-rate", "0.002", "--no-try-focal")
    assert json.loads(posted[0]["files"]["request"][1])["options"] == sent


def test_a_deviation_without_a_height_is_refused(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*given, "--camera-height-std", "0.02") == 1
    assert "--camera-height-std: it needs a height" in capsys.readouterr().err


@pytest.mark.parametrize("rest", [{}, REFUSED])
def test_the_threshold_is_printed_beside_the_confidence(rest: Any) -> None:
    out = io.StringIO()
    stated = {"confidence": 0.75, "threshold": {"confidence": 0.9, "false_accept_rate": 0.01}}
    print_answer(ANSWER | rest | stated, Console(file=out, width=200))
    assert "(confidence 0.750; LOCALIZED from 0.90)" in out.getvalue()


@pytest.mark.parametrize("rest", [{}, REFUSED])
@pytest.mark.parametrize("name", [None, "mule"])
def test_the_correction_for_the_rig_is_printed(rest: Any, name: str | None) -> None:
    out = io.StringIO()
    print_answer(ANSWER | rest | {"rig_correction": name}, Console(file=out, width=200))
    assert ("confidence corrected for mule" in out.getvalue()) is (name is not None)


@pytest.mark.parametrize("rest", [{}, REFUSED])
@pytest.mark.parametrize(("outside", "shown"), [({}, False), ({"front": 5.2}, True)])
def test_an_extrapolated_confidence_is_printed_with_its_features(rest: Any, outside: Any, shown: bool) -> None:
    out = io.StringIO()
    print_answer(ANSWER | rest | {"extrapolated": outside}, Console(file=out, width=200))
    assert ("extrapolated (standard deviations from the mean: front +5.2)" in out.getvalue()) is shown


@pytest.mark.parametrize("rest", [{}, REFUSED])
@pytest.mark.parametrize(
    ("origin", "why"), [("given", ""), ("estimated", ""), ("assumed", "; the depth image shows no ground")]
)
def test_the_height_of_the_camera_is_printed_with_its_origin(rest: Any, origin: str, why: str) -> None:
    out = io.StringIO()
    print_answer(ANSWER | rest | {"camera_height": {"height_m": 0.312, "origin": origin}}, Console(file=out, width=200))
    assert f"0.31 m above the ground ({origin}{why}" in out.getvalue()
