"""A short run of ``make chaos``, on a tiny map: nothing is wrong or lost, and workers agree."""

import json
from collections.abc import Callable
from pathlib import Path

from benchmarks.chaos.asking import Pair
from benchmarks.chaos.disk import small_disk
from benchmarks.chaos.run import Chaos
from benchmarks.serving.bodies import multipart
from model_training.loadtest.payloads import Payload
from service.client.grpc_messages import request_message
from service.client.prepare import PreparedRequest
from service.contract import schema

#: With this seed the steps have most kinds of action, and no restart of the whole service, which takes seconds.
SEED, STEPS, WORKERS = 3, 20, 2


def payload_of(parts: dict[str, bytes]) -> Payload:
    document = schema.LocalizeRequest.model_validate(json.loads(parts["request"]))
    message = request_message(PreparedRequest(document, ((parts["rgb"], parts["depth"]),)))
    return Payload(*multipart(parts), message, None)


def test_nothing_is_wrong_or_lost_and_workers_agree(
    bundle_path: Path, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    pair = Pair(payload_of(parts_of()), payload_of(parts_of(options={"refine": False})))
    told: list[str] = []
    with small_disk(64, may_mount=False) as disk:
        chaos = Chaos(disk, bundle_path, pair, seed=SEED, workers=WORKERS, tell=told.append)
        found = chaos.run(STEPS, stop_at_first=True)
    assert not found.wrong + found.disagreements, "\n".join(told)
    assert found.steps == STEPS
    assert found.answers > 10 * STEPS
