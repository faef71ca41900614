"""For those who load with Locust; ``streetfix loadtest`` does more (gRPC, processor time, right answers).

    pip install locust
    STREETFIX_CLIENT_DATASET=data/small locust -f model_training/loadtest/locustfile.py --host http://127.0.0.1:8000

``STREETFIX_CLIENT_QUERIES`` names a query set, ``STREETFIX_CLIENT_MAP`` a map, ``STREETFIX_API_KEY`` a key.
``STREETFIX_CLIENT_REFINE=0`` asks for retrieval alone.
"""

import itertools
import os
from pathlib import Path

from locust import HttpUser, constant, task  # type: ignore[import-not-found,unused-ignore]  # the user's own

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
    """Asks the next query when it has an answer."""

    wait_time = constant(0)

    def on_start(self) -> None:
        """Every robot begins at a query of its own."""
        self._turn = itertools.cycle(PAYLOADS[id(self) % len(PAYLOADS) :] + PAYLOADS[: id(self) % len(PAYLOADS)])

    @task  # type: ignore[untyped-decorator,unused-ignore]
    def localize(self) -> None:
        """One pair; what is no answer counts as failed. An answer that is not LOCALIZED is one."""
        payload = next(self._turn)
        headers = {"Content-Type": payload.content_type} | ({} if KEY is None else {"Authorization": f"Bearer {KEY}"})
        with self.client.post("/v1/localize", data=payload.body, headers=headers, catch_response=True) as answer:
            if answer.status_code == 200 and answer.json().get("status") is None:
                answer.failure("no answer")
