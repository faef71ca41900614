"""Random steps against a running service; after each, all its workers must answer correctly and alike."""

import os
import signal
import socket
import struct
import subprocess
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

import grpc
import numpy as np

from benchmarks.chaos.asking import FACES, TIMEOUT_S, Asking, Caller, Face, Outcome, Pair, What
from benchmarks.chaos.disk import Disk
from benchmarks.chaos.oracle import Expected, Oracle, Version
from benchmarks.chaos.shelf import Shelf
from benchmarks.serving.machines import Server, kill_tree, launch
from model_training.loadtest.processes import descendants
from service.errors import StreetfixError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.runtime.keys import hash_of, new_key

#: Longest time until all workers must agree, and until a stopped service must have ended.
SETTLED_S, ENDED_S = 120.0, 120.0
#: Time within which every worker has read the folder after SIGHUP.
_LOOKED_S = 3.0
_SAME_M = 0.01
_MOST_BUNDLES, _MOST_DAMAGED, _MOST_HALVES, _MOST_SOCKETS, _FULL_STEPS = 6, 3, 2, 24, 5


@dataclass
class Findings:
    """Findings of a run.

    Attributes:
        seed: seed that repeats the run.
        steps: number of steps done.
        answers: number of answers checked.
        refusals: number of clear errors, by code.
        wrong: answers that were wrong, lost or no clear error; also services that ended, or did not end, against
            expectation.
        disagreements: disagreements of workers: two versions at once, or an old version after a new one.
        actions: how often each action was done.
        tracebacks: number of tracebacks in the service's log.
        disk: how a full disk was simulated.
    """

    seed: int
    steps: int = 0
    answers: int = 0
    refusals: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    disagreements: list[str] = field(default_factory=list)
    actions: Counter[str] = field(default_factory=Counter)
    tracebacks: int = 0
    disk: str = ""


@dataclass
class Step:
    """Effect of a step.

    Attributes:
        expected: versions that may serve after it.
        strict_s: time from which only the last version may answer; None means after settling.
        cut: spans from the kill of a worker until it was gone; a request that ran then may be lost.
        is_away: spans in which the service was down; a request that began then may be lost.
        outcomes: outcomes of the step's own requests.
    """

    expected: Expected
    strict_s: float | None = None
    cut: list[tuple[float, float]] = field(default_factory=list)
    is_away: list[tuple[float, float]] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def excuses(self, outcome: Outcome) -> bool:
        """Return whether the step itself made an answer impossible.

        Args:
            outcome: outcome of a request.
        """
        cut = any(outcome.began_s <= gone and outcome.ended_s >= killed for killed, gone in self.cut)
        return cut or any(start <= outcome.began_s <= end for start, end in self.is_away)


class Chaos:
    """One run.

    Args:
        disk: disk of the maps and of the service's temporary files.
        bundle: the map.
        pair: the known query.
        seed: seed of all choices.
        workers: number of workers of the service.
        tell: receives a line for the user.
        log: receives a line for each action, and the lines that the service logs.
    """

    def __init__(
        self,
        disk: Disk,
        bundle: Path,
        pair: Pair,
        *,
        seed: int,
        workers: int,
        tell: Callable[[str], None],
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._random = Random(seed)  # noqa: S311  # replayable
        self._disk, self._workers, self._tell, self._record = disk, workers, tell, log
        self._shelf = Shelf(disk.folder, bundle, self._random)
        self._temporary = disk.folder / "tmp"
        self._temporary.mkdir()
        # on another disk, so that it can be replaced while this one is full
        self._keys_file = disk.folder.parent / "keys.txt"
        self._operator, self._retired = new_key(), deque[str](maxlen=4)
        self._keys_are_broken = False
        self._sockets: list[socket.socket] = []
        self._number = self._full_since = 0
        self._sighup_s = 0.0
        self._whole_s: float | None = None
        self._valid = [new_key()]
        self._caller = Caller(_free_port(), _free_port(), pair, self._valid[0])
        self._reference: dict[tuple[Face, What], tuple[float, float, float]] = {}
        self._done: deque[str] = deque(maxlen=15)
        self._log: deque[str] = deque(maxlen=2000)
        self.findings = Findings(seed, disk="a file system of its own" if disk.is_mounted else "a limit on file sizes")
        self._write_keys()
        name, version = self._shelf.add()
        self._oracle = Oracle({name: version})
        self._server: Server | None = None
        self._serving = version.id

    def run(self, steps: int, *, stop_at_first: bool = False) -> Findings:
        """Do the steps and return the findings.

        Args:
            steps: number of steps.
            stop_at_first: end at the first wrong, lost or differing answer.

        Raises:
            RuntimeError: the service does not start, or does not answer the known query.
        """
        try:
            self._start()
            self._learn()
            with Asking(self._caller) as heard:
                for number in range(1, steps + 1):
                    before = len(self.findings.wrong) + len(self.findings.disagreements)
                    self._step(number, heard)
                    self.findings.steps = number
                    if len(self.findings.wrong) + len(self.findings.disagreements) > before:
                        self._tell(f"seed {self.findings.seed}, step {number}; last actions:")
                        for line in self._done:
                            self._tell(f"    {line}")
                        for line in islice(reversed(self._log), 12):
                            self._tell(f"    log: {line}")
                        if stop_at_first:
                            break
                        self._begin_again(heard)
        finally:
            self._close_sockets()
            self._kill()
        return self.findings

    def _step(self, number: int, heard: Callable[[], list[Outcome]]) -> None:
        self._number = number
        name = self._choose(number)
        before = self._serving
        self._done.append(f"step {number}: {name}")
        self.findings.actions[name] += 1
        try:
            step = self._actions[name](self)
        except _ServiceError as error:
            self._wrong(str(error))
            heard()
            return
        step.expected = self._oracle.unsure(step.expected)
        self._note_whole()
        if self._whole_s is not None and time.monotonic() > self._whole_s + _LOOKED_S:
            self._oracle.is_unsure = False
        self._done[-1] += f"; {' or '.join(sorted(step.expected.finals))} serves"
        if self._server is not None and self._server.process.poll() is not None:
            self._wrong(f"the service ended unexpectedly, with {self._server.process.returncode}")
            heard()
            return
        self._record(self._done[-1])
        probes, settled_s = self._settle(step.expected)
        for face in FACES:
            probes.append(self._caller.ask(face, "full"))
        if self._retired:
            self._ask_with_a_retired_key()
        self._judge(before, step, settled_s, [*heard(), *step.outcomes, *probes])

    def _choose(self, number: int) -> str:
        """Return the next action, among those that make sense now."""
        if self._disk.is_full and number - self._full_since >= _FULL_STEPS:
            return "free disk"
        oracle, shelf = self._oracle, self._shelf
        possible = {
            "add": 10,
            "damage": 4 * (len(shelf.damaged) < _MOST_DAMAGED),
            "clear damaged": 3 * bool(shelf.damaged),
            "begin copy": 4 * (len(shelf.halves) < _MOST_HALVES),
            "finish copy": 4 * bool(shelf.halves),
            "drop copy": 1 * bool(shelf.halves),
            "stash": 6 * (len(oracle.on_disk) > 1),
            "restore": 6 * bool(shelf.stashed),
            "delete": 4 * (len(oracle.on_disk) > 1),
            "choose": 12 * (len(oracle.open) > 1),
            "choose unknown": 2,
            "sighup": 6,
            "sighup often": 2,
            "kill": 9,
            "kill several": 2,
            "kill all": 1,
            "restart": 3,
            "restart at once": 1,
            "slow": 4,
            "abort": 4,
            "release": 3 * bool(self._sockets),
            "fill disk": 3 * (not self._disk.is_full),
            "free disk": 6 * self._disk.is_full,
            "new keys": 5,
            "more keys": 3,
            "broken keys": 2 * (not self._keys_are_broken),
            "stream": 3,
        }
        if len(oracle.on_disk) >= _MOST_BUNDLES:
            possible |= {"add": 0, "restore": 0, "finish copy": 0, "delete": 15}
        if self._disk.is_full:  # a killed worker may fail to restart before there is space
            possible |= {"kill several": 0, "kill all": 0}
        if self._keys_are_broken:  # a killed worker restarts only after the keys are repaired, so one must remain
            possible |= {
                "new keys": 15,
                "kill": 0,
                "kill several": 0,
                "kill all": 0,
                "restart": 0,
                "restart at once": 0,
            }
        return self._random.choices(list(possible), list(possible.values()))[0]

    # Actions. Each returns what must hold after it.

    def _add(self) -> Step:
        try:
            name, version = self._shelf.add()
        except OSError:
            return self._same("the disk was full")
        return self._appeared(name, version)

    def _restore(self) -> Step:
        name = self._random.choice(sorted(self._shelf.stashed))
        return self._appeared(name, self._shelf.restore(name))

    def _finish_copy(self) -> Step:
        name = self._random.choice(sorted(self._shelf.halves))
        version = self._shelf.finish_copy(name)
        return self._same(f"{name}: the disk was full") if version is None else self._appeared(name, version)

    def _appeared(self, name: str, version: Version) -> Step:
        """Expect a new valid bundle: the service notices it by itself, or SIGHUP tells it to look."""
        expected = self._oracle.appeared(name, version)
        self._note(f"{name} {version.id}")
        if self._random.random() < 0.5:
            return Step(expected)
        self._note("with SIGHUP")
        self._signal(signal.SIGHUP)
        return Step(expected.then(self._oracle.sighup()))

    def _damage(self) -> Step:
        return self._maybe_sighup(self._shelf.damage())

    def _clear_damaged(self) -> Step:
        return self._maybe_sighup(self._shelf.clear_damaged())

    def _begin_copy(self) -> Step:
        return self._maybe_sighup(self._shelf.begin_copy())

    def _drop_copy(self) -> Step:
        name = self._random.choice(sorted(self._shelf.halves))
        self._shelf.drop_copy(name)
        return self._maybe_sighup(name)

    def _stash(self) -> Step:
        name = self._random.choice(sorted(self._oracle.on_disk))
        return self._removed(name, lambda: self._shelf.stash(name, self._oracle.on_disk[name]))

    def _delete(self) -> Step:
        name = self._random.choice(sorted(self._oracle.on_disk))
        return self._removed(name, lambda: self._shelf.delete(name))

    def _removed(self, name: str, remove: Callable[[], None]) -> Step:
        """Remove a bundle; SIGHUP may or may not announce it."""
        told = self._random.random() < 0.5 or not self._is_whole()
        if not told:  # wait, so that no worker notices the removal because of an earlier SIGHUP
            time.sleep(max(0.0, self._sighup_s + _LOOKED_S - time.monotonic()))
        remove()
        self._oracle.removed(name)
        self._note(name)
        return self._sighup() if told else self._same()

    def _is_whole(self) -> bool:
        """Return whether all workers answer and have processed what was pending at their start, such as an earlier SIGHUP."""
        self._note_whole()
        if self._whole_s is None:
            return False
        time.sleep(max(0.0, self._whole_s + _LOOKED_S - time.monotonic()))
        return True

    def _note_whole(self) -> None:
        """Record the time since which all workers answer."""
        if len(_listeners(self._caller.port, self._pids())) < self._workers:
            self._whole_s = None
        elif self._whole_s is None:
            self._whole_s = time.monotonic()

    def _maybe_sighup(self, told: str) -> Step:
        self._note(told)
        return self._sighup() if self._random.random() < 0.5 else self._same()

    def _sighup(self) -> Step:
        self._note("SIGHUP")
        self._signal(signal.SIGHUP)
        return Step(self._oracle.sighup())

    def _sighup_often(self) -> Step:
        for _ in range(6):
            self._signal(signal.SIGHUP)
            time.sleep(self._random.uniform(0, 0.05))
        return Step(self._oracle.sighup())

    def _choose_version(self) -> Step:
        """Let an operator choose any open version; the service may refuse one without a folder."""
        version = self._random.choice([each for each in self._oracle.open if each != self._oracle.serving])
        status, code = self._caller.put(self._shelf.name, version.id, self._operator)
        gone = self._oracle.is_gone(version)
        self._note(f"{version.id}{' (its folder is gone)' if gone else ''}: {status} {code}")
        if status == 200:
            return Step(self._oracle.choose(version), strict_s=time.monotonic())
        if (gone and status == 404) or (self._disk.is_full and status in (503, 507)):
            return self._same()
        raise _ServiceError(f"PUT of the open version {version.id} is refused: {status} {code}")

    def _choose_unknown(self) -> Step:
        name, version = self._shelf.name, self._oracle.open[-1].id
        status, code, wanted = self._random.choice(
            [
                (*self._caller.put(name, "0123456789abcdef", self._operator), "unknown-map"),
                (*self._caller.put("elsewhere", version, self._operator), "unknown-map"),
                (*self._caller.put(name, version, self._caller.key), "forbidden"),
                (*self._caller.put(name, version, new_key()), "unauthorized"),
            ]
        )
        if code != wanted:
            raise _ServiceError(f"PUT that must be refused as {wanted}: {status} {code}")
        return self._same(wanted)

    def _kill_one(self) -> Step:
        return self._kill_workers(1)

    def _kill_several(self) -> Step:
        return self._kill_workers(max(1, self._workers - 1))

    def _kill_all(self) -> Step:
        step = self._kill_workers(self._workers)
        step.is_away = [(step.cut[0][0], time.monotonic() + SETTLED_S)]
        return step

    def _kill_workers(self, count: int) -> Step:
        """Kill some workers; keep one that answers unless all must go."""
        there = sorted(self._pids() - {self._running.process.pid})
        victims = self._random.sample(there, min(count, len(there)))
        answering = _listeners(self._caller.port, there)
        if count < self._workers and not answering - set(victims):
            victims = [pid for pid in victims if answering and pid != min(answering)]
        killed = time.monotonic()
        for pid in victims:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:  # already ended
                continue
        while any(Path(f"/proc/{pid}").exists() for pid in victims):  # its sockets close when its last thread ends
            time.sleep(0.005)
        cut = [(killed, time.monotonic())]
        self._note(f"{len(victims)} of {len(there)}")
        self._whole_s = None
        return Step(self._oracle.worker_started_again(), cut=cut)

    def _restart(self) -> Step:
        began = time.monotonic()
        self._end(signal.SIGTERM)
        self._start_or_free()
        return Step(self._oracle.start(), is_away=[(began, time.monotonic())])

    def _restart_at_once(self) -> Step:
        """Send SIGTERM while the service starts, as when a deployment is undone, then start it for good."""
        began = time.monotonic()
        self._end(signal.SIGTERM)
        started = self._launch()
        time.sleep(self._random.uniform(0.0, 2.5))
        started.send_signal(signal.SIGTERM)
        try:
            _, log = started.communicate(timeout=ENDED_S)
        except subprocess.TimeoutExpired as error:
            kill_tree(started.pid)
            raise _ServiceError("a service that got SIGTERM while it started does not end") from error
        self._log.extend(log.splitlines())
        if "Traceback" in log:
            raise _ServiceError(f"a service that got SIGTERM while it started shows a traceback: {log[-300:]}")
        self._start_or_free()
        return Step(self._oracle.start(), is_away=[(began, time.monotonic())])

    def _slow(self) -> Step:
        """Open connections that begin a request and then stall; they stay open for some steps."""
        request = _request_head(self._caller.key, len(self._caller.pair.full.body), self._caller.pair.full.content_type)
        beginnings = [
            (self._caller.port, b""),
            (self._caller.port, request[: len(request) // 2]),
            (self._caller.port, request + self._caller.pair.full.body[:5000]),
            (self._caller.grpc_port, b""),
            (self._caller.grpc_port, _PREFACE),
            (self._caller.grpc_port, _PREFACE + b"\x00\x10\x00\x01\x04"),
        ]
        for _ in range(min(3, _MOST_SOCKETS - len(self._sockets))):
            port, sent = self._random.choice(beginnings)
            self._sockets.append(connection := socket.create_connection(("127.0.0.1", port), timeout=10))
            connection.sendall(sent)
        return self._same(f"{len(self._sockets)} are open")

    def _abort(self) -> Step:
        """Cut requests off: reset their connection, or cancel their call."""
        body, content_type = self._caller.pair.full.body, self._caller.pair.full.content_type
        head = _request_head(self._caller.key, len(body), content_type)
        for sent in (head + body[: self._random.randrange(len(body))], head + body):
            with socket.create_connection(("127.0.0.1", self._caller.port), timeout=10) as connection:
                connection.sendall(sent)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with grpc.insecure_channel(f"127.0.0.1:{self._caller.grpc_port}") as channel:
            stub = LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]  # generated code
            metadata = (("authorization", f"Bearer {self._caller.key}"),)
            call = stub.Localize.future(self._caller.pair.full.message, timeout=10, metadata=metadata)
            time.sleep(self._random.uniform(0, 0.05))
            call.cancel()
        return self._same()

    def _release(self) -> Step:
        self._close_sockets()
        return self._same()

    def _fill_disk(self) -> Step:
        self._disk.fill(self._pids())
        self._full_since = self._number
        return self._same()

    def _free_disk(self) -> Step:
        self._disk.free(self._pids())
        return self._same()

    def _new_keys(self) -> Step:
        """Replace all keys by new ones."""
        old = [*self._valid]
        self._valid = [new_key()]
        self._operator = new_key()
        self._write_keys()
        self._signal(signal.SIGHUP)
        self._caller.key = self._valid[0]
        self._until_keys_hold(old)
        self._retired.extend(old)
        return Step(self._oracle.sighup())

    def _more_keys(self) -> Step:
        """Add a key to the existing ones."""
        self._valid.append(new_key())
        self._write_keys()
        self._signal(signal.SIGHUP)
        self._until_keys_hold([])
        self._caller.key = self._valid[-1]
        return Step(self._oracle.sighup())

    def _break_keys(self) -> Step:
        """Write an invalid key file: the previous keys stay valid."""
        self._keys_are_broken = True
        self._keys_file.write_text(self._random.choice(["", "robot\n", "robot 12\n", "\0\n"]))
        self._signal(signal.SIGHUP)
        time.sleep(0.3)
        return Step(self._oracle.sighup())

    def _stream(self) -> Step:
        """Send a stream of three frames; the serving version must answer each."""
        frames = [pb.LocalizeStreamRequest(frame=self._caller.pair.full.message)] * 3
        metadata = (("authorization", f"Bearer {self._caller.key}"),)
        began = time.monotonic()
        with grpc.insecure_channel(f"127.0.0.1:{self._caller.grpc_port}") as channel:
            stub = LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]  # generated code
            try:
                found = list(stub.LocalizeStream(iter(frames), timeout=TIMEOUT_S, metadata=metadata))
            except grpc.RpcError as error:
                raise _ServiceError(f"a stream of three frames ended with {error}") from error
        step = self._same()
        for each in found:
            problem = each.outcome.problem.code if each.outcome.HasField("problem") else ""
            version = "" if problem else each.outcome.answer.map.version
            step.outcomes.append(
                Outcome(
                    began, time.monotonic(), "grpc", "stream", "lost" if problem else "answer", version, told=problem
                )
            )
        if len(found) != len(frames):
            raise _ServiceError(f"a stream of {len(frames)} frames got {len(found)} answers")
        return step

    _actions: dict[str, Callable[["Chaos"], Step]] = {  # noqa: RUF012  # never changed
        "add": _add,
        "restore": _restore,
        "finish copy": _finish_copy,
        "damage": _damage,
        "clear damaged": _clear_damaged,
        "begin copy": _begin_copy,
        "drop copy": _drop_copy,
        "stash": _stash,
        "delete": _delete,
        "sighup": _sighup,
        "sighup often": _sighup_often,
        "choose": _choose_version,
        "choose unknown": _choose_unknown,
        "kill": _kill_one,
        "kill several": _kill_several,
        "kill all": _kill_all,
        "restart": _restart,
        "restart at once": _restart_at_once,
        "slow": _slow,
        "abort": _abort,
        "release": _release,
        "fill disk": _fill_disk,
        "free disk": _free_disk,
        "new keys": _new_keys,
        "more keys": _more_keys,
        "broken keys": _break_keys,
        "stream": _stream,
    }

    # Checks.

    def _settle(self, expected: Expected) -> tuple[list[Outcome], float]:
        """Send requests until all answers are alike and correct twice in a row; return the outcomes and the time of settling."""
        probes, alike, until = list[Outcome](), 0, time.monotonic() + SETTLED_S
        while True:
            began = time.monotonic()
            turns: tuple[Face, ...] = ("rest", "rest", "rest", "grpc") * self._workers
            found = [self._caller.ask(face, "maps") for face in turns]
            probes += found
            versions = {each.version for each in found if each.kind == "answer"}
            listed = {version for each in found for version in each.listed}
            good = len(versions) == 1 and versions <= expected.finals and all(each.kind == "answer" for each in found)
            good = good and not listed & expected.dropped
            alike = alike + 1 if good else 0
            if alike == 2:
                everywhere = set.intersection(*(set(each.listed) for each in found))
                self._serving = found[0].version
                if why := self._oracle.adopt(self._serving, everywhere, self._shelf.known):
                    self._wrong(why)
                return probes, began
            if time.monotonic() > until:
                self._not_settled(found, versions, listed, expected)
                return probes, began

    def _not_settled(self, found: list[Outcome], versions: set[str], listed: set[str], expected: Expected) -> None:
        told = f"{', '.join(sorted(versions)) or 'nothing'} answers instead of {' or '.join(sorted(expected.finals))}"
        if len(versions) > 1:
            self._disagree(f"workers do not agree: {told}")
        elif versions - expected.finals:
            self._wrong(f"the wrong version serves: {told}")
        elif stale := listed & expected.dropped:
            self._wrong(f"{', '.join(sorted(stale))} is listed after SIGHUP, though its folder is gone")
        else:
            others = {str(each) for each in found if each.kind != "answer"}
            self._wrong(f"no answer: {told}; {'; '.join(sorted(others)[:3])}")

    def _judge(self, before: str, step: Step, settled_s: float, outcomes: list[Outcome]) -> None:
        """Count the outcomes of a step, and record the wrong ones."""
        path, finals = step.expected.path, step.expected.finals
        allowed = {before, *path, *finals}
        order = {version: k for k, version in enumerate(path)}
        answers = [each for each in outcomes if each.kind == "answer"]
        self.findings.answers += len(answers)
        for each in outcomes:
            if each.kind == "refusal":
                self.findings.refusals[each.told] += 1
                if each.told == "unauthorized" and each.began_s > settled_s and each.with_key == self._caller.key:
                    self._disagree(f"a valid key is refused: {each}")
            elif each.kind == "lost" and not step.excuses(each):
                self._wrong(str(each))
        for each in answers:
            at = each.position_m
            reference = self._reference.get((each.face, each.what))
            if each.version not in allowed:
                self._wrong(f"a version that cannot serve: {each}")
            elif at is not None and reference is not None and np.abs(np.subtract(at, reference)).max() > _SAME_M:
                self._wrong(f"{at} instead of {reference}: {each}")
            elif each.began_s > settled_s and each.version != self._serving and not self._oracle.is_unsure:
                self._disagree(f"{each}, though {self._serving} serves")
            elif step.strict_s is not None and each.began_s > step.strict_s and each.version not in finals:
                self._disagree(f"{each}, though {path[-1]} was chosen")
        # Once an answer names a version, no later request may get an answer from an earlier version.
        for k in range(1, len(path)):
            ends = [each.ended_s for each in answers if order.get(each.version, len(path)) >= k]
            for each in answers if ends else ():
                if order.get(each.version, len(path)) < k and each.began_s > min(ends) and each.began_s <= settled_s:
                    self._disagree(f"{each}, though {path[k]} had answered {each.began_s - min(ends):.3f} s before")

    def _ask_with_a_retired_key(self) -> None:
        found = self._caller.ask(self._random.choice(FACES), "maps", key=self._random.choice([*self._retired]))
        if found.kind != "refusal":
            self._wrong(f"a key that was removed from the file is not refused: {found}")

    def _until_keys_hold(self, old: Iterable[str]) -> None:
        """Send requests until every worker accepts the valid keys and refuses the old ones, twice in a row."""
        alike, until = 0, time.monotonic() + SETTLED_S
        while alike < 2:
            asked = [(key, True) for key in self._valid] + [(key, False) for key in old]
            found = [
                (self._caller.ask(face, "maps", key=key), holds)
                for key, holds in asked
                for face in FACES
                for _ in range(2 * self._workers)
            ]
            good = all((each.kind == "answer") if holds else each.told == "unauthorized" for each, holds in found)
            alike = alike + 1 if good else 0
            if not good and time.monotonic() > until:
                wrong = [str(each) for each, holds in found if holds == (each.kind != "answer")]
                self._disagree(f"some workers do not accept the keys of the new file: {'; '.join(wrong[:3])}")
                return

    def _learn(self) -> None:
        """Record the correct answers before the first action."""
        for face in FACES:
            for what in ("full", "retrieval"):
                found = self._caller.ask(face, what)
                if found.position_m is None:
                    raise RuntimeError(f"the known pair is not answered: {found}")
                self._reference[face, what] = found.position_m
        told = self._caller.pair.full.true_m
        at = self._reference["rest", "full"]
        if told is not None and np.linalg.norm(np.subtract(at, told)) > 1.0:
            raise RuntimeError(
                f"the answer to the known pair is {at}, but its true position is {told}; choose another pair"
            )

    # The service.

    @property
    def _running(self) -> Server:
        if self._server is None:
            raise RuntimeError("no service runs")
        return self._server

    def _pids(self) -> set[int]:
        try:
            return descendants(self._running.process.pid)
        except StreetfixError:  # already ended
            return set()

    def _settings(self) -> dict[str, Any]:
        return {
            "workers": self._workers,
            "threads": 1,
            "watch_s": 0.5,
            "drain_s": 0.5,
            "grace_s": 10,
            "request_timeout_s": 120,
            "api_keys": self._keys_file,
        }

    def _launch(self) -> subprocess.Popen[str]:
        return launch(
            self._shelf.folder,
            port=self._caller.port,
            grpc_port=self._caller.grpc_port,
            stderr=subprocess.PIPE,
            temporary=self._temporary,
            **self._settings(),
        )

    def _start(self) -> None:
        """Start the service and keep its log.

        Raises:
            RuntimeError: it ended before it was ready, or not all workers answer.
        """
        self._server = Server(
            self._shelf.folder,
            core=None,
            port=self._caller.port,
            grpc_port=self._caller.grpc_port,
            log=self._take_line,
            temporary=self._temporary,
            **self._settings(),
        )
        # Wait for all workers: a failure before each has answered once counts as a failed start and ends the service.
        until = time.monotonic() + SETTLED_S
        while len(_listeners(self._caller.port, self._pids())) < self._workers:
            if time.monotonic() > until:
                raise RuntimeError(f"not all workers listen {SETTLED_S:g} s after the first one")
            time.sleep(0.02)

    def _take_line(self, line: str) -> None:
        self._log.append(line.rstrip())
        self._record(line.rstrip())
        self.findings.tracebacks += line.startswith("Traceback")

    def _start_or_free(self) -> None:
        """Start the service; a full disk may prevent it if the service says so, but a free disk may not."""
        try:
            self._start()
        except RuntimeError as error:
            if not self._disk.is_full:
                raise _ServiceError(str(error)) from error
            self._note("the service does not start while the disk is full")
            self._disk.free(())
            try:
                self._start()
            except RuntimeError as again:
                raise _ServiceError(str(again)) from again

    def _end(self, number: signal.Signals) -> None:
        """Send a signal to end the service, and wait.

        Raises:
            _ServiceError: it did not end, or ended with an error.
        """
        self._signal(number)
        try:
            code = self._running.wait(ENDED_S)
        except subprocess.TimeoutExpired as error:
            raise _ServiceError(f"the service did not end within {ENDED_S:g} s of {number.name}") from error
        if code:
            raise _ServiceError(f"the service ended with {code} after {number.name}")

    def _signal(self, number: signal.Signals) -> None:
        self._sighup_s = time.monotonic()
        self._running.process.send_signal(number)

    def _kill(self) -> None:
        if self._server is not None:
            kill_tree(self._server.process.pid)
            self._server.wait(30)
            self._server = None

    def _begin_again(self, heard: Callable[[], list[Outcome]]) -> None:
        """Start a new service over the same bundles after a finding."""
        self._kill()
        self._close_sockets()
        self._disk.free(())
        self._write_keys()
        try:
            self._start()
        except RuntimeError as error:
            self._wrong(f"the service does not start with the files on the disk: {error}")
            for name in list(self._shelf.halves):
                self._shelf.drop_copy(name)
            while self._shelf.damaged:
                self._shelf.clear_damaged()
            self._start()
        self._settle(self._oracle.start())
        heard()

    def _write_keys(self) -> None:
        self._keys_are_broken = False
        lines = [f"robot{k} {hash_of(key)}" for k, key in enumerate(self._valid)]
        part = self._keys_file.with_suffix(".part")
        part.write_text("\n".join([*lines, f"operator {hash_of(self._operator)} operator", ""]))
        part.rename(self._keys_file)

    def _close_sockets(self) -> None:
        for connection in self._sockets:
            connection.close()
        self._sockets.clear()

    def _same(self, told: str = "") -> Step:
        if told:
            self._note(told)
        return Step(self._oracle.unchanged())

    def _note(self, told: str) -> None:
        self._done[-1] += f", {told}"

    def _wrong(self, told: str) -> None:
        self._found(self.findings.wrong, "WRONG", told)

    def _disagree(self, told: str) -> None:
        self._found(self.findings.disagreements, "DISAGREEMENT", told)

    def _found(self, findings: list[str], kind: str, told: str) -> None:
        findings.append(f"step {self._number}: {told}")
        self._record(f"{kind}, step {self._number}: {told}")
        here = sum(each.startswith(f"step {self._number}: ") for each in findings[-4:])
        if here <= 3:  # one cause may affect hundreds of answers
            self._tell(f"{kind}, step {self._number}: {told}")


class _ServiceError(Exception):
    """The service violated its contract."""


_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"


def _request_head(key: str, length: int, content_type: str) -> bytes:
    return (
        f"POST /v1/localize HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {key}\r\n"
        f"Content-Type: {content_type}\r\nContent-Length: {length}\r\n\r\n"
    ).encode()


def _listeners(port: int, pids: Iterable[int]) -> set[int]:
    """Return the processes among ``pids`` that listen on a port of 127.0.0.1."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    sockets = {f"socket:[{row[9]}]" for row in rows if row[1] == f"0100007F:{port:04X}" and row[3] == "0A"}
    found = set()
    for pid in pids:
        try:
            files = {os.readlink(each) for each in Path(f"/proc/{pid}/fd").iterdir()}
        except OSError:  # the process ended, or closed a file meanwhile
            continue
        if files & sockets:
            found.add(pid)
    return found


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])
