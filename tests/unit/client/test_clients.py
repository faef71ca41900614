"""The sync and the async client behave equally. A fake transport controls requests and responses."""

import asyncio
import email
import email.policy
import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import httpx
import numpy as np
import pytest

from service.client import (
    AsyncClient,
    Client,
    Frame,
    GrpcClient,
    Options,
    PinholeCamera,
    Prior,
    PriorPosition,
    PriorWgs84,
    rest,
)
from service.client.retry import RetryPolicy
from service.client.tls import ClientTls
from service.contract.schema import Camera as SchemaCamera
from service.errors import (
    ForeignServiceError,
    NoAnswerInTimeError,
    NotLocalizedError,
    RefusedError,
    RequestError,
    StreetfixError,
    UnavailableError,
    UnreachableError,
)

RGB, DEPTH = np.full((4, 6, 3), 7, np.uint8), np.full((4, 6), 2.5, np.float32)
CAMERA = PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
Handler = Callable[[httpx.Request], httpx.Response]
Json = Callable[..., dict[str, Any]]


class Asking:
    """Calls a method of either client; ``waited_s`` collects the delays."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.waited_s: list[float] = []

    def __call__(
        self, handler: Handler, method: str, *args: Any, url: str = "http://x:1", given: Any = None, **how: Any
    ) -> Any:
        settings: dict[str, Any] = {"transport": httpx.MockTransport(handler), "draw": lambda: 0.0} | (given or {})
        if self.kind == "sync":
            with Client(url, sleep=self.waited_s.append, **settings) as client:
                return getattr(client, method)(*args, **how)

        async def sleep(seconds: float) -> None:
            self.waited_s.append(seconds)

        async def ask() -> Any:
            async with AsyncClient(url, sleep=sleep, **settings) as client:
                return await getattr(client, method)(*args, **how)

        return asyncio.run(ask())


@pytest.fixture(params=["sync", "async"])
def ask(request: pytest.FixtureRequest) -> Asking:
    return Asking(request.param)


def parts_of(request: httpx.Request) -> dict[str, bytes]:
    """Return the parts of a multipart body, split by Python's mail parser."""
    head = f"Content-Type: {request.headers['content-type']}\r\n\r\n".encode()
    message = email.message_from_bytes(head + request.content, policy=email.policy.HTTP)
    parts: list[Any] = [part for part in message.walk() if not part.is_multipart()]
    return {str(part.get_param("name", header="content-disposition")): part.get_payload(decode=True) for part in parts}


def problem(status: int, **changed: Any) -> httpx.Response:
    content = {
        "type": "/problems/x",
        "title": "T.",
        "status": status,
        "detail": "D",
        "code": "x",
        "field": "camera.fx",
        "request_id": "r1",
    }
    return httpx.Response(status, json=content | changed)


@pytest.mark.parametrize(("given", "frame"), [({}, b"\x28\xb5\x2f\xfd"), ({"depth_codec": "lz4"}, b"\x04\x22\x4d\x18")])
def test_depth_goes_by_the_codec_that_was_chosen(ask: Asking, answer_json: Json, given: Any, frame: bytes) -> None:
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer_json())

    ask(handler, "localize", RGB, DEPTH, CAMERA, given=given)
    assert parts_of(seen[0])["depth"][12:16] == frame


def test_files_are_sent_unchanged_and_leave_the_scale_to_the_service(ask: Asking, answer_json: Json) -> None:
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer_json())

    ask(handler, "localize", b"a JPEG", b"a PNG", CAMERA)
    ask(handler, "localize_sequence", [Frame(rgb=b"a JPEG", depth=DEPTH, camera=CAMERA)])
    ask(handler, "localize", RGB, b"a PNG", CAMERA, depth_scale_m=0.0002)
    files, sequence, scaled = map(parts_of, seen)
    assert (files["rgb"], files["depth"]) == (b"a JPEG", b"a PNG")
    assert json.loads(files["request"])["depth"]["scale_m"] is None
    assert (sequence["rgb0"], sequence["depth0"][:4]) == (b"a JPEG", b"SFD1")
    assert (scaled["rgb"][:2], scaled["depth"]) == (b"\xff\xd8", b"a PNG")
    assert json.loads(scaled["request"])["depth"]["scale_m"] == 0.0002


def test_only_a_fisheye_lens_sends_its_model(ask: Asking, answer_json: Json) -> None:
    """An earlier service refuses unknown fields. It refuses coefficients by itself."""
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer_json())

    bent = replace(CAMERA, distortion=(-0.3, 0.1, 0.0, 0.0))
    fisheye = replace(CAMERA, distortion=(0.0,) * 4, distortion_model="kannala_brandt")
    told = SchemaCamera(
        width=6, height=4, fx=3, fy=3, cx=2.5, cy=1.5, distortion=[0.1, 0, 0, 0], distortion_model="kannala_brandt"
    )
    for camera in (CAMERA, bent, fisheye, told):
        ask(handler, "localize", RGB, DEPTH, camera)
    lenses = [json.loads(parts_of(each)["request"])["camera"] for each in seen]
    assert [each["distortion"] for each in lenses] == [[], [-0.3, 0.1, 0, 0], [0, 0, 0, 0], [0.1, 0, 0, 0]]
    assert [each.get("distortion_model") for each in lenses] == [None, None, "kannala_brandt", "kannala_brandt"]


def test_a_lens_with_too_few_coefficients_is_refused_before_it_is_sent(ask: Asking) -> None:
    camera = replace(CAMERA, distortion=(0.1,))
    with pytest.raises(RequestError, match=r"camera\.distortion: the model brown_conrady does not have 1 coefficients"):
        ask(lambda _: httpx.Response(500), "localize", RGB, DEPTH, camera)


@pytest.mark.parametrize(("rgb", "depth", "field"), [(b"", DEPTH, "rgb"), (RGB, b"", "depth")])
def test_an_empty_file_is_refused(ask: Asking, rgb: Any, depth: Any, field: str) -> None:
    with pytest.raises(RequestError, match=f"{field}: the file is empty") as caught:
        ask(lambda _: httpx.Response(500), "localize", rgb, depth, CAMERA)
    assert caught.value.field == field


def test_the_parts_are_what_the_contract_asks_for(ask: Asking, answer_json: Json) -> None:
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer_json())

    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    answer = ask(
        handler,
        "localize",
        RGB,
        DEPTH,
        CAMERA,
        given={"api_key": "k"},
        map="tiny",
        gravity=[0.0, 1.0, 0.0],
        T_vehicle_camera=T,
        prior=Prior(position=PriorPosition(x=1.0, y=2.0), heading_deg=90.0),
        options=Options(neighbours=3),
    )
    parts = parts_of(seen[0])
    document = json.loads(parts["request"])
    assert (seen[0].method, seen[0].url.path, seen[0].headers["authorization"]) == ("POST", "/v1/localize", "Bearer k")
    assert len(seen[0].headers["x-streetfix-cell"]) >= 8  # any cell: the query has no prior
    assert (parts["rgb"][:2], parts["depth"][:4]) == (b"\xff\xd8", b"SFD1")
    assert document["map"] == "tiny"
    assert document["gravity"] == {"x": 0, "y": 1, "z": 0}
    assert document["depth"] == {"scale_m": 0.001, "kind": "z", "max_range_m": None, "baseline_m": None}
    assert document["T_vehicle_camera"]["position"] == {"x": 1, "y": 2, "z": 3}
    assert document["prior"] == {"position": {"x": 1, "y": 2}, "heading_deg": 90}
    assert document["options"] == {"neighbours": 3}
    assert (answer.status, answer.confidence, answer.require_pose().position.x) == ("LOCALIZED", 0.75, 1.0)


@pytest.mark.parametrize("status", ["AMBIGUOUS", "OUT_OF_MAP"])
def test_an_answer_that_is_not_localized_has_no_pose_to_use(
    ask: Asking, answer_json: Json, refused_of: Json, status: str
) -> None:
    answer = ask(lambda _: httpx.Response(200, json=refused_of(answer_json(), status)), "localize", RGB, DEPTH, CAMERA)
    assert (answer.status, answer.pose, answer.vehicle_pose, answer.geopose, answer.street) == (
        status,
        None,
        None,
        None,
        None,
    )
    for wanted in (answer.require_pose, answer.require_vehicle_pose):
        with pytest.raises(NotLocalizedError, match=f"the answer is {status}") as caught:
            wanted()
        assert caught.value.answer is answer
    assert [each.confirmed for each in answer.hypotheses] == [False, False]


@pytest.mark.parametrize(
    "lie",
    [
        {"status": "OUT_OF_MAP"},  # a pose all the same, as before
        {"pose": None},
        {
            "spread": {
                "mean": {"x": 0, "y": 0, "z": 0},
                "covariance": [0.0] * 9,
                "heading_std_deg": 0,
                "hypotheses_weight": 1,
            }
        },
        {"reasons": [{"check": "baseline", "evidence": {"log_noise": 4.0}, "remedy": "check it"}]},
    ],
)
def test_an_answer_whose_status_and_pose_contradict_each_other_is_none(
    ask: Asking, answer_json: Json, lie: dict[str, Any]
) -> None:
    with pytest.raises(ForeignServiceError, match="has another contract"):
        ask(lambda _: httpx.Response(200, json=answer_json(**lie)), "localize", RGB, DEPTH, CAMERA)


@pytest.mark.parametrize("kept", ["street", "vehicle_pose"])
def test_a_refused_answer_contains_nothing_of_its_best_hypothesis(
    ask: Asking, answer_json: Json, refused_of: Json, kept: str
) -> None:
    was = answer_json(vehicle_pose=answer_json()["pose"])
    with pytest.raises(ForeignServiceError):
        ask(lambda _: httpx.Response(200, json=refused_of(was, **{kept: was[kept]})), "localize", RGB, DEPTH, CAMERA)


def test_a_confirmed_hypothesis_of_a_refused_answer_is_none(ask: Asking, answer_json: Json, refused_of: Json) -> None:
    content = refused_of(answer_json())
    content["hypotheses"][0]["confirmed"] = True
    with pytest.raises(ForeignServiceError):
        ask(lambda _: httpx.Response(200, json=content), "localize", RGB, DEPTH, CAMERA)


def test_reading_a_vehicle_pose_that_was_not_requested_gives_a_clear_error(ask: Asking, answer_json: Json) -> None:
    answer = ask(lambda _: httpx.Response(200, json=answer_json()), "localize", RGB, DEPTH, CAMERA)
    with pytest.raises(RequestError, match="send T_vehicle_camera"):
        answer.require_vehicle_pose()


def test_a_sequence_says_where_each_camera_stood(ask: Asking, answer_json: Json) -> None:
    def handler(request: httpx.Request) -> httpx.Response:
        parts = parts_of(request)
        frames = json.loads(parts["request"])["frames"]
        assert request.url.path == "/v1/localize/sequence"
        assert sorted(parts) == ["depth0", "depth1", "request", "rgb0", "rgb1"]
        assert len(request.headers["x-streetfix-cell"]) >= 8
        assert frames[0]["T_reference_camera"] is None
        assert frames[1]["T_reference_camera"]["position"]["z"] == 1.0
        return httpx.Response(200, json=answer_json())

    ahead = np.eye(4)
    ahead[2, 3] = 1.0
    frames = [Frame(rgb=RGB, depth=DEPTH, camera=CAMERA, T_reference_camera=T) for T in (None, ahead)]
    assert ask(handler, "localize_sequence", frames).map.name == "tiny"


def test_a_batch_has_answers_and_refusals_in_their_places(ask: Asking, answer_json: Json) -> None:
    refusal = {
        "title": "T.",
        "status": 422,
        "detail": "D",
        "code": "no-depth",
        "field": "requests.1.depth",
        "request_id": "r",
    }
    outcomes = [{"answer": answer_json(), "problem": None}, {"answer": None, "problem": refusal}]
    frames = [Frame(rgb=RGB, depth=DEPTH, camera=CAMERA)] * 2

    def handler(request: httpx.Request) -> httpx.Response:
        assert request.headers["x-streetfix-cell"].startswith("m-")
        return httpx.Response(200, json={"outcomes": outcomes})

    first, second = ask(handler, "localize_batch", frames, map="m")
    assert first.status == "LOCALIZED"
    assert isinstance(second, RefusedError)
    assert (second.problem, second.field) == ("no-depth", "requests.1.depth")


def test_maps_streets_and_coverage_are_read(ask: Asking) -> None:
    entry = {
        "name": "a/b",
        "version": "v",
        "made_at": "2026",
        "places": 1,
        "views": 2,
        "streets": 3,
        "spacing_m": 1.0,
        "encoder_sha256": "e",
        "georeferenced": False,
        "licence": "L",
        "versions": ["v"],
    }
    collection = {"type": "FeatureCollection", "features": []}
    answers = {"/v1/maps": {"maps": [entry]}, "/v1/maps/a%2Fb/streets": collection, "/v1/coverage": collection}

    def handler(request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, json=answers[request.url.raw_path.decode()])

    assert [each.name for each in ask(handler, "maps")] == ["a/b"]
    assert ask(handler, "streets", "a/b") == collection
    assert ask(handler, "coverage") == collection


def test_a_problem_is_reported_with_all_its_fields(ask: Asking) -> None:
    with pytest.raises(RefusedError) as caught:
        ask(lambda _: problem(422), "localize", RGB, DEPTH, CAMERA)
    error = caught.value
    assert (error.problem, error.field, error.detail, error.status, error.request_id) == (
        "x",
        "camera.fx",
        "D",
        "422",
        "r1",
    )
    assert error.message == "the service refused: T.\n  D [field camera.fx]\n  request id r1"


@pytest.mark.parametrize("status", [400, 401, 404, 413, 415, 422, 500, 504])
def test_a_permanently_refused_request_is_sent_once(ask: Asking, status: int) -> None:
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return problem(status)

    with pytest.raises(RefusedError):
        ask(handler, "maps")
    assert (len(seen), ask.waited_s) == (1, [])


@pytest.mark.parametrize("status", [429, 503])
def test_a_request_to_a_busy_service_is_repeated_after_the_advised_time(
    ask: Asking, answer_json: Json, status: int
) -> None:
    responses = [
        httpx.Response(status, headers={"Retry-After": "3"}),
        problem(status),
        httpx.Response(200, json=answer_json()),
    ]
    assert ask(lambda _: responses.pop(0), "localize", RGB, DEPTH, CAMERA).confidence == 0.75
    assert ask.waited_s == [3.0, 0.4]


def test_a_service_that_stays_busy_is_reported_with_its_last_advice(ask: Asking) -> None:
    with pytest.raises(UnavailableError) as caught:
        ask(
            lambda _: httpx.Response(503, headers={"Retry-After": "1"}),
            "maps",
            given={"retry": RetryPolicy(attempts=2)},
        )
    assert (caught.value.retry_after_s, ask.waited_s) == (1.0, [1.0])


def test_pictures_are_sent_again_whole(ask: Asking, answer_json: Json) -> None:
    bodies: list[bytes] = []

    def handler(request: httpx.Request) -> httpx.Response:
        bodies.append(parts_of(request)["rgb"])
        return problem(503) if len(bodies) == 1 else httpx.Response(200, json=answer_json())

    ask(handler, "localize", RGB, DEPTH, CAMERA)
    assert bodies[0] == bodies[1]


@pytest.mark.parametrize(
    ("status", "content"),
    [
        (200, {"text": "<html>"}),
        (200, {"json": {}}),
        (404, {"text": "<html>"}),
        (302, {}),
        (200, {"json": {"type": "Feature"}}),
    ],
)
@pytest.mark.parametrize("method", ["maps", "coverage"])
def test_another_server_at_the_address_is_reported(
    ask: Asking, method: str, status: int, content: dict[str, Any]
) -> None:
    with pytest.raises(ForeignServiceError, match="not Streetfix"):
        ask(lambda _: httpx.Response(status, **content), method)


def subclasses(root: type[Exception]) -> list[type[Exception]]:
    found = root.__subclasses__()
    return found + [deeper for each in found for deeper in subclasses(each)]


OF_HTTPX = sorted(
    {each for root in (httpx.HTTPError, httpx.StreamError) for each in subclasses(root) if each.__module__ == "httpx"}
    | {httpx.InvalidURL, httpx.CookieConflict},
    key=lambda each: each.__name__,
)


@pytest.mark.parametrize("kind", OF_HTTPX, ids=lambda kind: kind.__name__)
def test_every_exception_of_httpx_is_one_of_ours(kind: type[Exception]) -> None:
    error = kind.__new__(kind)
    Exception.__init__(error, "why")
    with pytest.raises(StreetfixError) as caught, rest.errors_of_httpx("http://x", 1.0, ClientTls()):
        raise error
    assert caught.value.__cause__ is error
    assert "http://x" in caught.value.message


@pytest.mark.parametrize(
    ("raised", "kind", "waits"),
    [
        (httpx.ConnectError("refused"), UnreachableError, 3),
        (httpx.ReadError("reset"), UnreachableError, 3),
        (httpx.ConnectTimeout("slow"), UnreachableError, 3),
        (httpx.ReadTimeout("slow"), NoAnswerInTimeError, 0),
        (httpx.PoolTimeout("slow"), NoAnswerInTimeError, 0),
        (httpx.LocalProtocolError("bad"), RequestError, 0),
    ],
    ids=lambda each: type(each).__name__,
)
def test_only_a_lost_connection_is_tried_again(
    ask: Asking, raised: Exception, kind: type[Exception], waits: int
) -> None:
    def handler(_: httpx.Request) -> httpx.Response:
        raise raised

    with pytest.raises(kind):
        ask(handler, "maps")
    assert len(ask.waited_s) == waits


@pytest.mark.parametrize("url", ["", "localhost:8000", "http://[", "ftp://x", "http://"])
def test_an_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(RequestError, match="pass http://HOST:PORT"):
        Client(url)


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(timeout_s: float) -> None:
    with pytest.raises(RequestError, match="timeout_s"):
        AsyncClient("http://x", timeout_s=timeout_s)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None),
        ("2", 2.0),
        (" 5 ", 5.0),
        ("Sun, 22 Nov 2026 00:00:30 GMT", 30.0),
        ("Sat, 21 Nov 2026 00:00:00 GMT", 0.0),
        ("Sun, 22 Nov 2026 00:00:30 -0000", 30.0),
        ("soon", None),
        ("-1", None),
        ("1.5", None),
    ],
)
def test_retry_after_is_a_number_or_a_date(header: str | None, seconds: float | None) -> None:
    assert rest.retry_after_s(header, now=datetime(2026, 11, 22, tzinfo=UTC)) == seconds


@pytest.mark.parametrize(
    ("about", "field"),
    [
        ({"gravity": [0.0, 1.0]}, "gravity"),
        ({"T_vehicle_camera": np.eye(3)}, "T_vehicle_camera"),
        ({"T_vehicle_camera": 2 * np.eye(4)}, "T_vehicle_camera"),
        ({"T_vehicle_camera": np.diag([1.0, 2.0, 1.0, 1.0])}, "T_vehicle_camera"),
        ({"depth_kind": "up"}, "depth.kind"),
        ({"depth_scale_m": -1.0}, "depth_scale_m"),
        ({"map": "m" * 65}, "map"),
        (
            {"prior": Prior(position=PriorPosition(x=0, y=0), wgs84=PriorWgs84(latitude_deg=0, longitude_deg=0))},
            "prior",
        ),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_sent(ask: Asking, about: dict[str, Any], field: str) -> None:
    with pytest.raises(RequestError) as caught:
        ask(lambda _: pytest.fail("sent"), "localize", RGB, DEPTH, CAMERA, **about)
    assert caught.value.field == field


def test_an_unknown_argument_is_a_type_error(ask: Asking) -> None:
    with pytest.raises(TypeError, match="unknown argument 'heading'"):
        ask(lambda _: pytest.fail("sent"), "localize", RGB, DEPTH, CAMERA, heading=3)


def test_a_bad_frame_is_named_by_its_number(ask: Asking) -> None:
    frames = [Frame(rgb=RGB, depth=DEPTH, camera=CAMERA), Frame(rgb=DEPTH, depth=DEPTH, camera=CAMERA)]  # type: ignore[arg-type]  # on purpose
    for method in ("localize_sequence", "localize_batch"):
        with pytest.raises(RequestError, match=r"^frames\.1\.rgb: ") as caught:
            ask(lambda _: pytest.fail("sent"), method, frames)
        assert caught.value.field == "frames.1.rgb"


def test_pairs_of_a_batch_stand_alone(ask: Asking) -> None:
    frames = [Frame(rgb=RGB, depth=DEPTH, camera=CAMERA, T_reference_camera=np.eye(4))]
    with pytest.raises(RequestError, match="not allowed in a batch; use localize_sequence"):
        ask(lambda _: pytest.fail("sent"), "localize_batch", frames)


def test_an_empty_request_is_refused(ask: Asking) -> None:
    for method in ("localize_sequence", "localize_batch"):
        with pytest.raises(RequestError, match="at least 1 item"):
            ask(lambda _: pytest.fail("sent"), method, [])


def test_all_that_is_exported_is_there() -> None:
    import service.client as package

    assert package.__all__ == sorted(package.__all__)
    assert all(hasattr(package, name) for name in package.__all__)


@pytest.mark.parametrize(
    ("camera", "about", "height"),
    [
        (CAMERA, {}, {}),
        (CAMERA, {"camera_height_m": 0.3}, {"height_m": 0.3}),
        (CAMERA, {"camera_height_m": 0.3, "camera_height_std_m": 0.02}, {"height_m": 0.3, "height_std_m": 0.02}),
        (SchemaCamera(width=6, height=4, fx=3, fy=3, cx=2.5, cy=1.5, height_m=0.4), {}, {"height_m": 0.4}),
        (
            SchemaCamera(width=6, height=4, fx=3, fy=3, cx=2.5, cy=1.5, height_m=0.4),
            {"camera_height_m": 0.3},
            {"height_m": 0.3},
        ),
    ],
)
def test_a_camera_height_is_sent_only_where_it_is_known(
    ask: Asking, answer_json: Json, camera: Any, about: dict[str, Any], height: dict[str, float]
) -> None:
    """An earlier service refuses unknown fields."""
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer_json(camera_height={"height_m": 0.3, "origin": "given"}))

    answer = ask(handler, "localize", RGB, DEPTH, camera, **about)
    ask(handler, "localize_sequence", [Frame(rgb=RGB, depth=DEPTH, camera=camera, **about)])
    alone, sequence = (json.loads(parts_of(each)["request"]) for each in seen)
    for sent in (alone["camera"], sequence["frames"][0]["camera"]):
        assert {name: value for name, value in sent.items() if name.startswith("height_")} == height
    assert "vehicle_base_on_ground" not in alone | sequence
    assert (answer.camera_height.height_m, answer.camera_height.origin) == (0.3, "given")


def test_a_vehicle_frame_on_the_ground_is_sent(ask: Asking, answer_json: Json) -> None:
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        return httpx.Response(200, json=answer_json())

    ask(handler, "localize", RGB, DEPTH, CAMERA, T_vehicle_camera=np.eye(4), vehicle_base_on_ground=True)
    frame = Frame(rgb=RGB, depth=DEPTH, camera=CAMERA)
    ask(handler, "localize_sequence", [frame], T_vehicle_camera=np.eye(4), vehicle_base_on_ground=True)
    assert [json.loads(parts_of(each)["request"])["vehicle_base_on_ground"] for each in seen] == [True, True]


def test_an_earlier_service_gives_no_camera_height(ask: Asking, answer_json: Json) -> None:
    assert ask(lambda _: httpx.Response(200, json=answer_json()), "localize", RGB, DEPTH, CAMERA).camera_height is None


@pytest.mark.parametrize(
    ("about", "field"),
    [
        ({"camera_height_std_m": 0.1}, "camera_height_std_m"),
        ({"camera_height_m": 0.01}, "camera.height_m"),
        ({"camera_height_m": 1.0, "camera_height_std_m": 3.0}, "camera.height_std_m"),
    ],
)
def test_a_height_that_is_none_is_refused_before_it_is_sent(ask: Asking, about: dict[str, Any], field: str) -> None:
    with pytest.raises(RequestError) as caught:
        ask(lambda _: httpx.Response(500), "localize", RGB, DEPTH, CAMERA, **about)
    assert caught.value.field == field


@pytest.mark.parametrize("make", [Client, AsyncClient, GrpcClient])
@pytest.mark.parametrize(
    ("key", "why"),
    [("", "is empty"), ("abc\n", "a line break"), ("a b", "has a space"), ("schl\u00fcssel", "another character")],
)
def test_a_key_that_no_service_has_is_refused_at_once(make: Any, key: str, why: str) -> None:
    address = "127.0.0.1:1" if make is GrpcClient else "http://127.0.0.1:1"
    with pytest.raises(RequestError, match=rf"api_key: it .*{why}.*`streetfix keys`") as caught:
        make(address, api_key=key)
    assert caught.value.field == "api_key"
