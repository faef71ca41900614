"""Send requests to a service, each on a new connection so that any worker may answer, and record the outcomes."""

import http.client
import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import grpc
import numpy as np
from google.rpc import error_details_pb2
from grpc_status import rpc_status

from model_training.loadtest.payloads import Payload
from service import errors
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.http.problems import CODE_OF_STATUS

Kind = Literal["answer", "refusal", "lost"]
What = Literal["maps", "full", "retrieval", "stream"]
Face = Literal["rest", "grpc"]
FACES: tuple[Face, ...] = ("rest", "grpc")
#: Longest wait for an answer, seconds. It is generous: this check does not measure speed, and other work may share the
#: machine.
TIMEOUT_S = 150.0
_OPTIONS = (("grpc.use_local_subchannel_pool", 1), ("grpc.max_receive_message_length", -1), ("grpc.enable_retries", 0))


def _codes() -> frozenset[str]:
    """Return the codes of all problems that tell a caller what is wrong; `internal` tells nothing."""
    kinds, waiting = set[str](), [errors.StreetfixError]
    while waiting:
        kind = waiting.pop()
        kinds.add(kind.code)
        waiting += kind.__subclasses__()
    return frozenset((kinds | set(CODE_OF_STATUS.values())) - {"internal", "error"})


KNOWN_CODES = _codes()


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one request.

    Attributes:
        began_s: monotonic time before the request was sent, seconds.
        ended_s: monotonic time when its outcome was known, seconds.
        face: ``rest`` or ``grpc``.
        what: kind of request.
        kind: ``answer``; ``refusal`` for a clear error (a problem with a known code, or a gRPC status with details);
            ``lost`` for anything else.
        version: map version that answered.
        listed: open versions, if the request listed maps.
        position_m: position of the answer in the map frame, or of its best hypothesis if it has no pose.
        told: code of the error, or what happened.
        with_key: API key of the request.
    """

    began_s: float
    ended_s: float
    face: Face
    what: What
    kind: Kind
    version: str = ""
    listed: tuple[str, ...] = ()
    position_m: tuple[float, float, float] | None = None
    told: str = ""
    with_key: str = ""

    def __str__(self) -> str:
        result = self.version if self.kind == "answer" else self.told
        return f"{self.face} {self.what}: {self.kind} {result} ({self.ended_s - self.began_s:.2f} s)"


@dataclass(frozen=True, slots=True)
class Pair:
    """The known query, as a request with registration and as one without."""

    full: Payload
    retrieval: Payload


class Caller:
    """Client of one service; its key may change at any time.

    Args:
        port: port of REST.
        grpc_port: port of gRPC.
        pair: the query to send.
        key: API key of a caller.
    """

    def __init__(self, port: int, grpc_port: int, pair: Pair, key: str) -> None:
        self.port, self.grpc_port = port, grpc_port
        self.pair, self.key = pair, key

    def ask(self, face: Face, what: What, *, key: str | None = None) -> Outcome:
        """Send one request on its own connection; never raise for what the service does.

        Args:
            face: ``rest`` or ``grpc``.
            what: kind of request.
            key: API key; None takes the client's key.
        """
        used = self.key if key is None else key
        began = time.monotonic()
        kind, told = self._rest(what, used) if face == "rest" else self._grpc(what, used)
        return Outcome(began, time.monotonic(), face, what, kind, with_key=used, **told)

    def put(self, name: str, version: str, operator_key: str) -> tuple[int, str]:
        """Choose the version that serves; return HTTP status and problem code, with status 0 if there is no answer.

        Args:
            name: name of the map.
            version: version to serve.
            operator_key: API key of an operator.
        """
        headers = {"Authorization": f"Bearer {operator_key}", "Content-Type": "application/json"}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT_S)
        try:
            connection.request(
                "PUT", f"/v1/maps/{name}/serving", body=json.dumps({"version": version}), headers=headers
            )
            response = connection.getresponse()
            content = response.read()
        except (OSError, http.client.HTTPException) as error:
            return 0, repr(error)
        finally:
            connection.close()
        return response.status, "" if response.status == 200 else _problem(response, content)

    def _rest(self, what: What, key: str) -> tuple[Kind, dict[str, Any]]:
        headers = {"Authorization": f"Bearer {key}", "Connection": "close"}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT_S)
        try:
            if what == "maps":
                connection.request("GET", "/v1/maps", headers=headers)
            else:
                sent = self.pair.full if what == "full" else self.pair.retrieval
                connection.request(
                    "POST", "/v1/localize", body=sent.body, headers=headers | {"Content-Type": sent.content_type}
                )
            response = connection.getresponse()
            content = response.read()
        except (OSError, http.client.HTTPException) as error:
            return "lost", {"told": repr(error)}
        finally:
            connection.close()
        if response.status != 200:
            code = _problem(response, content)
            return ("refusal" if code in KNOWN_CODES else "lost"), {"told": code}
        try:
            answer = json.loads(content)
            if what == "maps":
                return _of_maps([(each["version"], tuple(each["versions"])) for each in answer["maps"]])
            pose = answer.get("pose") or answer["hypotheses"][0]["pose"]
            at = tuple(pose["position"][axis] for axis in "xyz")
            return _of_answer(answer["map"]["version"], at)
        except (ValueError, KeyError, IndexError, TypeError) as error:
            return "lost", {"told": f"not a valid answer: {error!r}"}

    def _grpc(self, what: What, key: str) -> tuple[Kind, dict[str, Any]]:
        metadata = (("authorization", f"Bearer {key}"),)
        with grpc.insecure_channel(f"127.0.0.1:{self.grpc_port}", options=_OPTIONS) as channel:
            stub = LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]  # generated code
            try:
                if what == "maps":
                    found = stub.ListMaps(pb.ListMapsRequest(), timeout=TIMEOUT_S, metadata=metadata).maps
                    return _of_maps([(each.version, tuple(each.versions)) for each in found])
                sent = self.pair.full if what == "full" else self.pair.retrieval
                answer = stub.Localize(sent.message, timeout=TIMEOUT_S, metadata=metadata)
            except grpc.RpcError as error:
                return _of_status(error)
        if not answer.HasField("pose") and not answer.hypotheses:
            return "lost", {"told": "an answer without pose and hypotheses"}
        at = (answer.pose if answer.HasField("pose") else answer.hypotheses[0].pose).position
        return _of_answer(answer.map.version, (at.x, at.y, at.z))


def _of_maps(maps: list[tuple[str, tuple[str, ...]]]) -> tuple[Kind, dict[str, Any]]:
    if not maps:
        return "refusal", {"told": "no map is listed"}
    return "answer", {"version": maps[0][0], "listed": maps[0][1]}


def _of_answer(version: str, at: tuple[float, ...]) -> tuple[Kind, dict[str, Any]]:
    if not np.all(np.isfinite(at)):
        return "lost", {"told": f"a position that is not finite: {at}"}
    return "answer", {"version": version, "position_m": at}


def _problem(response: http.client.HTTPResponse, content: bytes) -> str:
    """Return the code of a problem, or the raw response if it is not a problem document."""
    if response.getheader("Content-Type", "").startswith("application/problem+json"):
        try:
            problem = json.loads(content)
            if problem["status"] == response.status and problem["detail"]:
                return str(problem["code"])
        except (ValueError, KeyError, TypeError):
            pass
    return f"{response.status} {content[:200].decode('utf-8', 'replace')}"


def _of_status(error: grpc.RpcError) -> tuple[Kind, dict[str, Any]]:
    if not isinstance(error, grpc.Call):
        return "lost", {"told": repr(error)}
    try:
        status = rpc_status.from_call(error)
    except ValueError:
        status = None
    info = error_details_pb2.ErrorInfo()
    for detail in () if status is None else status.details:
        if detail.Unpack(info) and info.reason in KNOWN_CODES:
            return "refusal", {"told": info.reason}
    return "lost", {"told": f"{error.code().name} {error.details()}"}


class Asking:
    """Threads that send requests continuously, each request on its own connection.

    Args:
        caller: client that sends.
        threads: number of threads.
        pause_s: pause of each thread between two requests, seconds.
    """

    def __init__(self, caller: Caller, *, threads: int = 2, pause_s: float = 0.08) -> None:
        self._caller = caller
        self._pause_s = pause_s
        self._outcomes: list[Outcome] = []
        self._failed: Exception | None = None
        self._lock, self._over = threading.Lock(), threading.Event()
        turns: list[list[tuple[Face, What]]] = [
            [("rest", "retrieval"), ("grpc", "maps")],
            [("grpc", "retrieval"), ("rest", "maps")],
        ]
        self._threads = [threading.Thread(target=self._run, args=(turns[k % 2],), daemon=True) for k in range(threads)]

    def __enter__(self) -> Callable[[], list[Outcome]]:
        """Start the threads; return a function that gives the outcomes since its last call."""
        for thread in self._threads:
            thread.start()
        return self._take

    def __exit__(self, *_: object) -> None:
        """Wait until the last requests end."""
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _run(self, turn: list[tuple[Face, What]]) -> None:
        each: Iterator[tuple[Face, What]] = itertools.cycle(turn)
        while not self._over.wait(self._pause_s):
            try:
                outcome = self._caller.ask(*next(each))
            except (
                Exception
            ) as error:  # a defect of the benchmark: a silent end of this thread would hide later failures
                self._failed = error
                return
            with self._lock:
                self._outcomes.append(outcome)

    def _take(self) -> list[Outcome]:
        if self._failed is not None:
            raise RuntimeError("a thread that sends queries has failed") from self._failed
        with self._lock:
            taken, self._outcomes = self._outcomes, []
        return taken
