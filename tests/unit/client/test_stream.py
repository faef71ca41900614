"""The stream of the gRPC client against a scripted servicer over a real socket: its order, its end, and every way a call can fail."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
import numpy as np
import pytest
from grpc_status import rpc_status

from service.client import (
    Client,
    GrpcClient,
    OdometryStd,
    Options,
    PinholeCamera,
    Prior,
    PriorPosition,
    PriorWgs84,
    RetryPolicy,
    StreamAnswer,
    StreamFrame,
    Track,
)
from service.client.epochs import Epochs
from service.contract import schema
from service.errors import (
    BusyError,
    DeadlineError,
    ForeignServiceError,
    NoAnswerInTimeError,
    RefusedError,
    RequestError,
    StreetfixError,
    UnauthorizedError,
    UnavailableError,
    UnreachableError,
)
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import (
    LocalizationServiceServicer,
    add_LocalizationServiceServicer_to_server,
)
from service.grpc.messages import answer_message, request_from
from service.grpc.status import status_of

RGB, DEPTH = np.full((4, 6, 3), 7, np.uint8), np.full((4, 6), 2.5, np.float32)
CAMERA = PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
AHEAD = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 2.0], [0, 0, 0, 1.0]])
TWO_POSITIONS = Prior(
    position=PriorPosition(x=1.0, y=2.0, std_m=3.0), wgs84=PriorWgs84(latitude_deg=1.0, longitude_deg=2.0, std_m=3.0)
)
GONE = (grpc.StatusCode.UNAVAILABLE, "gone")
SILENCE, END = object(), object()
Json = Callable[..., dict[str, Any]]


class Scripted(LocalizationServiceServicer):
    """Answers each frame of each call with the next reply of the call's script.

    A reply is a response, a service error, a status code with details, ``SILENCE`` until the call is cancelled, or ``END``.
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self, *scripts: list[Any]) -> None:
        self.scripts = list(scripts)
        self.asked: list[list[pb.LocalizeStreamRequest]] = []
        self.metadata: list[dict[str, Any]] = []
        self.half_closed, self.over = 0, threading.Semaphore(0)
        self.after_the_last_frame: Any = None

    def LocalizeStream(self, request_iterator: Any, context: grpc.ServicerContext) -> Iterator[Any]:
        script, asked, cancelled = self.scripts.pop(0), [], threading.Event()
        self.asked.append(asked)
        self.metadata.append(dict(context.invocation_metadata()))
        context.add_callback(cancelled.set)
        context.add_callback(self.over.release)
        for request in request_iterator:
            asked.append(request)
            reply = script.pop(0)
            if isinstance(reply, StreetfixError):
                context.abort_with_status(rpc_status.to_status(status_of(reply)))
            if isinstance(reply, tuple):
                context.abort(*reply)
            if reply is SILENCE:
                cancelled.wait(20)
                return
            if reply is END:
                return
            yield reply
        self.half_closed += 1
        if self.after_the_last_frame is not None:
            context.abort(*self.after_the_last_frame)


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[Scripted, str]]:
    scripted = Scripted()
    pool, all_started = ThreadPoolExecutor(4), threading.Barrier(5)
    for _ in range(4):  # tests count threads, so the server starts its own now
        pool.submit(all_started.wait)
    all_started.wait(10)
    server = grpc.server(pool)
    add_LocalizationServiceServicer_to_server(scripted, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield scripted, f"127.0.0.1:{port}"
    server.stop(None).wait()


@pytest.fixture
def service(served: tuple[Scripted, str]) -> Scripted:
    served[0].begin()
    return served[0]


@pytest.fixture
def waited_s() -> list[float]:
    return []


@pytest.fixture
def client(served: tuple[Scripted, str], service: Scripted, waited_s: list[float]) -> Iterator[GrpcClient]:
    with GrpcClient(served[1], api_key="k", timeout_s=10.0, sleep=waited_s.append, draw=lambda: 0.0) as client:
        yield client


@pytest.fixture
def reply(answer_json: Json) -> Callable[..., pb.LocalizeStreamResponse]:
    """Return a response with a belief of an epoch, at a position, LOCALIZED or not."""

    def make(epoch: int = 0, *, x: float = 1.0, frames: int = 1, localized: bool = True) -> pb.LocalizeStreamResponse:
        pose = {
            "position": {"x": x, "y": 2.0, "z": 3.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "heading_deg": 0.0,
            "covariance": None,
        }
        belief = {
            "epoch": epoch,
            "modes": [{"pose": pose, "weight": 0.75, "number": 0, "unseen": 0}],
            "elsewhere": 0.25,
            "outside": 0.0,
            "token": None,
        }
        lost: dict[str, Any] = {
            "status": "AMBIGUOUS",
            "pose": None,
            "street": None,
            "spread": {
                "mean": {"x": 0.0, "y": 0.0, "z": 0.0},
                "covariance": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0],
                "heading_std_deg": 20.0,
                "hypotheses_weight": 0.75,
            },
        }
        content = answer_json(belief=belief, **({"pose": pose} if localized else lost))
        answer = answer_message(schema.LocalizeAnswer.model_validate(content))
        return pb.LocalizeStreamResponse(outcome=pb.Outcome(answer=answer), frames=frames)

    return make


Reply = Callable[..., pb.LocalizeStreamResponse]


def frame(**changed: Any) -> StreamFrame:
    told: dict[str, Any] = {"rgb": RGB, "depth": DEPTH, "camera": CAMERA, "T_previous_camera": AHEAD}
    return StreamFrame(**(told | changed))


def epochs_of(answers: Any) -> list[int]:
    return [each.belief.epoch for each in answers]


def became(true: Callable[[], bool]) -> bool:
    until = time.monotonic() + 10
    while not true() and time.monotonic() < until:
        time.sleep(0.01)
    return true()


def test_each_answer_comes_before_the_next_frame_is_taken(client: GrpcClient, service: Scripted, reply: Reply) -> None:
    service.begin([reply(0, frames=1), reply(0, frames=2), reply(1, frames=3)])
    order: list[str] = []

    def drive() -> Iterator[StreamFrame]:
        for number in range(3):
            order.append(f"frame {number} in {threading.current_thread().name}")
            yield frame()

    here = threading.current_thread().name
    answers = []
    for answer in client.localize_stream(drive()):
        order.append("answer")
        answers.append(answer)
    assert order == [f"frame 0 in {here}", "answer", f"frame 1 in {here}", "answer", f"frame 2 in {here}", "answer"]
    assert [each.frames for each in answers if isinstance(each, StreamAnswer)] == [1, 2, 3]
    assert epochs_of(answers) == [0, 0, 1]
    assert service.over.acquire(timeout=10)
    assert (service.half_closed, len(service.asked)) == (1, 1)


def test_a_frame_is_read_by_the_service_as_written(client: GrpcClient, service: Scripted, reply: Reply) -> None:
    service.begin([reply(), reply()])
    prior = Prior(position=PriorPosition(x=1.0, y=2.0, std_m=3.0))
    std = OdometryStd(position_m=0.5, angle_deg=2.0)
    frames = [
        frame(T_previous_camera=None, prior=prior, gravity=[0.0, 1.0, 0.0], camera_height_m=0.3),
        frame(odometry_std=std, max_range_m=30.0),
    ]
    about: dict[str, Any] = {"map": "m", "options": Options(neighbours=7), "T_vehicle_camera": np.eye(4)}
    assert len(list(client.localize_stream(frames, **about))) == 2
    first, second = service.asked[0]
    read, later = request_from(first.frame), request_from(second.frame)
    assert read.prior == Prior(position=PriorPosition(x=1.0, y=2.0, std_m=3.0))
    assert (read.gravity, read.camera.height_m) == (schema.Direction(x=0, y=1, z=0), 0.3)
    assert (later.prior, later.gravity, later.depth.max_range_m) == (None, None, 30.0)
    for each in (read, later):
        assert (each.map, each.options.neighbours, each.track) == ("m", 7, None)
        assert each.T_vehicle_camera is not None
    assert not first.HasField("previous_from_camera")
    assert second.previous_from_camera.position.z == 2.0
    assert (second.odometry_std.position_m, second.odometry_std.angle_deg) == (0.5, 2.0)
    assert service.metadata[0]["authorization"] == "Bearer k"
    assert service.metadata[0]["x-streetfix-cell"] == "m-map-0-0"


def test_without_frames_nothing_is_asked(client: GrpcClient, service: Scripted) -> None:
    assert list(client.localize_stream([])) == []
    assert service.asked == []


def finish(client: GrpcClient) -> None:
    assert len(list(client.localize_stream([frame(), frame()]))) == 2


def leave_the_loop(client: GrpcClient) -> None:
    for _ in client.localize_stream(frame() for _ in range(5)):
        break


def close_the_generator(client: GrpcClient) -> None:
    answers = client.localize_stream(frame() for _ in range(5))
    next(answers)
    answers.close()


@pytest.mark.parametrize(
    ("end", "is_finished"), [(finish, True), (leave_the_loop, False), (close_the_generator, False)]
)
def test_the_end_of_a_stream_ends_its_call_and_leaves_no_thread(
    client: GrpcClient, service: Scripted, reply: Reply, end: Callable[[GrpcClient], None], is_finished: bool
) -> None:
    before = threading.active_count()
    for _ in range(20):
        service.begin([reply(), reply()])
        end(client)
        assert service.over.acquire(timeout=10)
        assert len(service.asked[0]) == (2 if is_finished else 1)
        assert service.half_closed == 1 or not is_finished
    assert became(lambda: threading.active_count() <= before)


def test_an_error_of_the_iterable_reaches_the_caller_and_ends_the_call(
    client: GrpcClient, service: Scripted, reply: Reply
) -> None:
    service.begin([reply()])

    def drive() -> Iterator[StreamFrame]:
        yield frame()
        raise ValueError("the camera is unplugged")

    answers = client.localize_stream(drive())
    next(answers)
    with pytest.raises(ValueError, match="the camera is unplugged"):
        next(answers)
    assert service.over.acquire(timeout=10)


def test_a_refused_frame_is_reported_in_its_place(client: GrpcClient, service: Scripted, reply: Reply) -> None:
    refusal = pb.Problem(code="no-depth", title="T.", detail="D", field="frame 1.depth")
    busy = pb.Problem(code="busy", title="T.", detail="D")
    problems = [pb.LocalizeStreamResponse(outcome=pb.Outcome(problem=each)) for each in (refusal, busy)]
    service.begin([reply(), *problems, reply(1)])
    first, second, third, fourth = client.localize_stream([frame()] * 4)
    assert isinstance(second, RefusedError)
    assert (second.problem, second.field) == ("no-depth", "frame 1.depth")
    assert isinstance(third, UnavailableError)
    assert epochs_of([first, fourth]) == [0, 1]
    assert len(service.asked) == 1


def test_a_lost_connection_begins_the_track_again(
    client: GrpcClient, service: Scripted, waited_s: list[float], reply: Reply
) -> None:
    """The second frame is sent again, without its odometry. The robot had a pose, so the epoch rises."""
    service.begin([reply(3), GONE], [GONE], [reply(0), reply(1)])
    std = OdometryStd(position_m=0.5, angle_deg=2.0)
    answers = list(client.localize_stream([frame(), frame(depth=DEPTH + 1, odometry_std=std), frame()]))
    assert epochs_of(answers) == [3, 4, 5]
    assert waited_s == [0.2, 0.4]
    _, lost = service.asked[0]
    again, after = service.asked[2]
    assert lost.HasField("odometry_std")
    assert (again.frame, again.HasField("previous_from_camera"), again.HasField("odometry_std")) == (
        lost.frame,
        False,
        False,
    )
    assert after.HasField("previous_from_camera")
    first, *opened_again = (each["x-streetfix-cell"] for each in service.metadata)
    assert not first.startswith("map-")  # nothing is known yet
    assert opened_again == ["map-0-0"] * 2  # that of the last answer


def test_a_track_without_a_pose_keeps_its_epoch(client: GrpcClient, service: Scripted, reply: Reply) -> None:
    service.begin([reply(2, localized=False), GONE], [reply(0)])
    assert epochs_of(client.localize_stream([frame(), frame()])) == [2, 2]


def test_a_track_that_began_again_without_a_pose_keeps_its_epoch(
    client: GrpcClient, service: Scripted, reply: Reply
) -> None:
    """The service counts the refused frame as a disruption. The track after it has no pose, so the lost connection is none."""
    refused = pb.LocalizeStreamResponse(outcome=pb.Outcome(problem=pb.Problem(code="no-depth", title="T.", detail="D")))
    service.begin([reply(0), refused, reply(1, localized=False), GONE], [reply(0), GONE], [reply(0)])
    first, _, *others = client.localize_stream([frame()] * 5)
    assert epochs_of([first, *others]) == [0, 1, 1, 2]


@pytest.mark.parametrize("close_after", [0, 1])
def test_a_closed_client_says_so(
    served: tuple[Scripted, str], service: Scripted, reply: Reply, close_after: int
) -> None:
    service.begin([reply(), reply()])
    client = GrpcClient(served[1], retry=RetryPolicy(backoff_s=0.0))
    answers = client.localize_stream([frame()] * 2)
    for _ in range(close_after):
        next(answers)
    client.close()
    for call in (lambda: next(answers), client.maps):
        with pytest.raises(RequestError, match="client: it is closed; make its calls"):
            call()


def test_the_limits_of_retries_hold_for_each_frame(
    client: GrpcClient, service: Scripted, waited_s: list[float], reply: Reply
) -> None:
    service.begin([GONE], [GONE], [GONE], [reply(), GONE], [GONE], [GONE], [GONE])
    answers = client.localize_stream([frame(), frame()])
    next(answers)
    with pytest.raises(UnreachableError, match="gone"):
        next(answers)
    assert waited_s == pytest.approx([0.2, 0.4, 0.8] * 2)
    assert list(answers) == []  # a generator that raised is over


def test_a_service_without_room_for_a_stream_is_asked_again(
    client: GrpcClient, service: Scripted, waited_s: list[float], reply: Reply
) -> None:
    service.begin([BusyError("w")], [reply()], [BusyError("w")], [BusyError("w")], [BusyError("w")], [BusyError("w")])
    assert len(list(client.localize_stream([frame()]))) == 1
    assert waited_s == [1.0]
    with pytest.raises(UnavailableError):
        list(client.localize_stream([frame()]))


@pytest.mark.parametrize("error", [UnauthorizedError("w"), DeadlineError("w")], ids=lambda error: error.code)
def test_a_stream_that_the_service_ends_is_not_opened_again(
    client: GrpcClient, service: Scripted, reply: Reply, error: StreetfixError
) -> None:
    service.begin([reply(), error])
    answers = client.localize_stream([frame(), frame()])
    next(answers)
    with pytest.raises(RefusedError) as caught:
        next(answers)
    assert (caught.value.problem, len(service.asked)) == (error.code, 1)


def test_a_frame_without_an_answer_in_time_ends_the_stream(
    served: tuple[Scripted, str], service: Scripted, reply: Reply
) -> None:
    service.begin([reply(), SILENCE])
    with GrpcClient(served[1], timeout_s=0.5) as client:
        answers = client.localize_stream([frame(), frame()])
        next(answers)
        time.sleep(0.7)  # the caller may take longer than that: the timeout is that of an answer
        with pytest.raises(NoAnswerInTimeError, match=r"no answer within 0\.5 s"):
            next(answers)
    assert service.over.acquire(timeout=10)
    assert len(service.asked) == 1


@pytest.mark.parametrize(
    ("last", "told"),
    [
        (END, "the stream ended without an answer"),
        (pb.LocalizeStreamResponse(), "neither an answer nor a problem"),
    ],
)
def test_a_stream_of_another_contract_is_reported(
    client: GrpcClient, service: Scripted, reply: Reply, last: Any, told: str
) -> None:
    service.begin([reply(), last])
    answers = client.localize_stream([frame(), frame()])
    next(answers)
    with pytest.raises(ForeignServiceError, match=told):
        next(answers)


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"depth": b""}, "frames.1.depth"),
        ({"T_previous_camera": np.eye(3)}, "frames.1.T_previous_camera"),
        ({"T_previous_camera": None, "odometry_std": OdometryStd(position_m=1, angle_deg=1)}, "frames.1.odometry_std"),
        ({"camera_height_std_m": 0.1}, "frames.1.camera_height_std_m"),
        ({"camera_height_m": 99.0}, "frames.1.camera.height_m"),
        ({"prior": TWO_POSITIONS}, "frames.1.prior"),
    ],
)
def test_an_invalid_frame_ends_the_stream_and_is_named(
    client: GrpcClient, service: Scripted, reply: Reply, changed: dict[str, Any], field: str
) -> None:
    service.begin([reply()])
    answers = client.localize_stream([frame(), frame(**changed)])
    next(answers)
    with pytest.raises(RequestError) as caught:
        next(answers)
    assert caught.value.field == field
    assert caught.value.message.startswith(f"{field}: ")
    assert service.over.acquire(timeout=10)
    assert len(service.asked[0]) == 1


def test_a_connection_that_is_lost_after_the_last_answer_takes_nothing(
    client: GrpcClient, service: Scripted, reply: Reply
) -> None:
    service.begin([reply()])
    service.after_the_last_frame = GONE
    assert len(list(client.localize_stream([frame()]))) == 1
    assert service.half_closed == 1


def test_an_unknown_option_is_refused_at_once(client: GrpcClient) -> None:
    with pytest.raises(TypeError, match="unknown argument 'prior'; pass one of map, T_vehicle_camera, options"):
        client.localize_stream([], prior=None)  # type: ignore[call-arg]  # it belongs to a frame


def test_an_answer_of_a_stream_carries_no_track(client: GrpcClient, service: Scripted, reply: Reply) -> None:
    service.begin([reply()])
    (answer,) = client.localize_stream([frame()])
    assert isinstance(answer, StreamAnswer)
    with Client("http://127.0.0.1:1", retry=RetryPolicy(attempts=1)) as rest, pytest.raises(RequestError) as caught:
        rest.localize(RGB, DEPTH, CAMERA, track=Track(before=answer, T_previous_camera=AHEAD))
    assert caught.value.field == "track.before"
    assert "comes from a stream" in caught.value.message


def test_an_answer_without_a_belief_is_not_counted(answer_json: Json) -> None:
    answer = StreamAnswer.model_validate(answer_json() | {"frames": 1})
    assert Epochs().counted(answer) is answer
