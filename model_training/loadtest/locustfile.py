"""Load test with Locust. ``streetfix loadtest`` does more: gRPC, processor time, correct answers.

Usage::

    pip install locust
    STREETFIX_CLIENT_DATASET=data/small locust -f model_training/loadtest/locustfile.py --host http://127.0.0.1:8000

``STREETFIX_CLIENT_QUERIES`` names a query set, ``STREETFIX_CLIENT_MAP`` a map, ``STREETFIX_API_KEY`` a key.
``STREETFIX_CLIENT_REFINE=0`` requests retrieval without registration.
"""

import itertools
import os
from pathlib import Path

from locust import HttpUser, constant, task  # type: ignore[import-not-found,unused-ignore]  # installed by the user

from model_training.datasets.dataset import Dataset
from model_training.loadtest.payloads import payloads

PAYLOADS = payloads(
    Dataset(Path(os.environ["STREETFIX_CLIENT_DATASET"])),
    os.environ.get("STREETFIX_CLIENT_QUERIES"),
    map_name=os.environ.get("STREETFIX_CLIENT_MAP"),
    refine=os.environ.get("STREETFIX_CLIENT_REFINE", "1") != "0",
    most=50,
)
KEY = os.environ.get("STREETFIX_API_KEY")


class Robot(HttpUser):  # type: ignore[misc,unused-ignore]  # untyped where Locust is not installed
    """A client that sends the next query after an answer."""

    wait_time = constant(0)

    def on_start(self) -> None:
        """Start each client at another query."""
        self._turn = itertools.cycle(PAYLOADS[id(self) % len(PAYLOADS) :] + PAYLOADS[: id(self) % len(PAYLOADS)])

    @task  # type: ignore[untyped-decorator,unused-ignore]
    def localize(self) -> None:
        """Send one query; a response without a status counts as failed, an answer with any status does not."""
        payload = next(self._turn)
        headers = {"Content-Type": payload.content_type} | ({} if KEY is None else {"Authorization": f"Bearer {KEY}"})
        with self.client.post("/v1/localize", data=payload.body, headers=headers, catch_response=True) as answer:
            if answer.status_code == 200 and answer.json().get("status") is None:
                answer.failure("no answer")
