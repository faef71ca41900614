import asyncio
import time

import numpy as np
import pytest

from model_training.cli.loadtest import table_of
from model_training.loadtest.drive import Load, Shot, arrivals, drive
from model_training.loadtest.payloads import Payload
from model_training.loadtest.summary import summarise
from model_training.loadtest.targets import Reply
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

PAYLOADS = [Payload(b"", "", pb.LocalizeRequest(), np.array([float(k), 0, 0])) for k in range(3)]


class Fake:
    """Answers after a delay, and records the requests."""

    def __init__(self, replies=None, *, takes_s=0.0):
        self.asked, self._replies, self._takes_s = [], replies, takes_s
        self.at_once = self.most_at_once = 0

    async def __aenter__(self):
        return self

    async def __aexit__(self, kind, error, trace):
        pass

    async def ask(self, payload, timeout_s):  # noqa: ARG002  # as the real ones are asked
        number = next(k for k, each in enumerate(PAYLOADS) if each is payload)
        self.asked.append(number)
        self.at_once += 1
        self.most_at_once = max(self.most_at_once, self.at_once)
        await asyncio.sleep(self._takes_s)
        self.at_once -= 1
        return (
            Reply("ok", "LOCALIZED", (float(number), 0.0, 0.0))
            if self._replies is None
            else self._replies(len(self.asked))
        )


def test_arrivals_are_a_poisson_process():
    """Their number has the mean and variance of the rate, their gaps are exponential, and the seed determines them."""
    counts = [len(arrivals(50, 10, seed)) for seed in range(200)]
    assert np.mean(counts) == pytest.approx(500, abs=6)
    assert np.var(counts) == pytest.approx(500, rel=0.3)
    gaps = np.diff(arrivals(100, 100, 1))
    assert gaps.std() == pytest.approx(gaps.mean(), rel=0.05)
    assert arrivals(5, 10, 3) == arrivals(5, 10, 3) != arrivals(5, 10, 4)
    assert max(arrivals(5, 10, 3)) < 10


def test_arrivals_do_not_wait_for_answers():
    """Forty per second of 0.5 s each need twenty at once, although no option sets this number."""
    target = Fake(takes_s=0.5)
    shots = asyncio.run(drive(target, PAYLOADS, Load(rate=40, warm_up_s=0, duration_s=1)))
    assert [shot.due_s for shot in shots] == arrivals(40, 1, 0)
    assert target.most_at_once > 8
    assert target.asked == [k % 3 for k in range(len(shots))]
    assert min(shot.done_s - shot.due_s for shot in shots) >= 0.5


def test_clients_wait_for_answers():
    target = Fake(takes_s=0.02)
    shots = asyncio.run(drive(target, PAYLOADS, Load(rate=None, concurrency=4, warm_up_s=0, duration_s=0.3)))
    assert target.most_at_once == 4
    assert 8 <= len(shots) <= 4 * 16


def test_latency_counts_from_when_a_request_was_due():
    """A target blocks the generator for 0.3 s. All requests due meanwhile count with their delay."""

    class Stops(Fake):
        async def ask(self, payload, timeout_s):
            if not self.asked:
                time.sleep(0.3)  # the very thing
            return await super().ask(payload, timeout_s)

    load = Load(rate=100, warm_up_s=0, duration_s=0.4)
    shots = asyncio.run(drive(Stops(), PAYLOADS, load))
    late = [shot.done_s - shot.due_s for shot in shots if shot.due_s < 0.2]
    assert len(late) > 5
    assert min(late) > 0.09
    found = summarise(shots, PAYLOADS, load, None, None)
    assert found.late_ms["max"] > 200  # told apart: it was not the target that was slow to answer
    assert "the load generator sent requests late" in str(table_of([found]).caption)


def test_a_generator_that_keeps_up_says_nothing_of_itself():
    load = Load(rate=20, warm_up_s=0, duration_s=0.3)
    shots = [Shot(due_s, due_s + 0.001, due_s + 0.5, 0, Reply("ok", "LOCALIZED")) for due_s in arrivals(20, 0.3, 0)]
    found = summarise(shots, PAYLOADS, load, None, None)
    assert found.late_ms["max"] == pytest.approx(1)
    assert "late" not in str(table_of([found]).caption)


def test_the_summary_counts_the_outcomes():
    def reply(number):
        return {0: Reply("503"), 1: Reply("ok", "AMBIGUOUS", (9.0, 0.0, 0.0))}.get(
            number % 4, Reply("ok", "LOCALIZED", (0.5, 0.0, 5.0))
        )

    load = Load(rate=200, warm_up_s=0.2, duration_s=0.5)
    shots = asyncio.run(drive(Fake(reply), PAYLOADS[:1], load))
    counted = [shot for shot in shots if shot.due_s >= 0.2]
    found = summarise(shots, PAYLOADS, load, None, None)
    refused = sum(shot.reply.code == "503" for shot in counted)
    assert found.errors == {"503": refused}
    assert found.answers == len(counted) - refused
    assert found.offered_per_s == pytest.approx(len(counted) / 0.5)
    assert found.localized == pytest.approx(2 / 3, abs=0.05)
    assert found.right == 1.0  # 0.5 m off on the ground; height does not count, nor do answers that are not LOCALIZED
    assert found.inconsistent > 0
    assert set(found.answered_ms) == {"p50", "p90", "p95", "p99", "max"}
    assert (found.cpu_ms_per_answer, found.resident_mib) == (None, None)


def test_answers_that_come_after_the_load_are_no_throughput():
    """The service answers ten per second, the load is twenty. Requests left at the end are answered, but too late to count."""

    class Queue(Fake):
        async def ask(self, payload, timeout_s):
            if not hasattr(self, "free_at"):
                self.free_at = time.perf_counter()
            self.free_at = max(self.free_at, time.perf_counter()) + 0.1
            await asyncio.sleep(self.free_at - time.perf_counter())
            return await super().ask(payload, timeout_s)

    load = Load(rate=20, warm_up_s=0, duration_s=1)
    found = summarise(asyncio.run(drive(Queue(), PAYLOADS, load)), PAYLOADS, load, None, None)
    assert found.offered_per_s >= 14
    assert 7 <= found.answered_per_s <= 10
    assert found.answers > found.answered_per_s


def test_a_request_is_given_up_in_time():
    load = Load(rate=20, warm_up_s=0, duration_s=0.3, timeout_s=0.1)
    shots = asyncio.run(drive(Fake(takes_s=5), PAYLOADS, load))
    assert {shot.reply.code for shot in shots} == {"timeout"}
    assert max(shot.done_s - shot.due_s for shot in shots) < 1


def test_answers_to_the_same_request_are_compared():
    load = Load(rate=100, warm_up_s=0, duration_s=0.3)
    shots = asyncio.run(drive(Fake(), PAYLOADS, load))
    assert summarise(shots, PAYLOADS, load, None, None).inconsistent == 0


def test_without_an_answer_there_are_no_figures_of_any():
    load = Load(rate=100, warm_up_s=0, duration_s=0.2)
    shots = asyncio.run(drive(Fake(lambda _: Reply("connection")), PAYLOADS, load))
    found = summarise(shots, PAYLOADS, load, None, None)
    assert (found.answers, found.answered_ms, found.localized, found.right) == (0, {}, None, None)
    assert found.errors == {"connection": len(shots)}
