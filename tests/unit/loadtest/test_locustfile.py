"""A fake Locust, which the project does not install."""

import importlib
import sys
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


@pytest.fixture
def robot(small_dataset, monkeypatch):
    locust: Any = ModuleType("locust")
    locust.HttpUser, locust.constant, locust.task = object, lambda seconds: seconds, lambda function: function
    monkeypatch.setitem(sys.modules, "locust", locust)
    monkeypatch.setenv("STREETFIX_CLIENT_DATASET", str(small_dataset.folder))
    monkeypatch.setenv("STREETFIX_API_KEY", "secret")
    monkeypatch.delitem(sys.modules, "model_training.loadtest.locustfile", raising=False)
    module = importlib.import_module("model_training.loadtest.locustfile")
    monkeypatch.delitem(sys.modules, "model_training.loadtest.locustfile")
    found = module.Robot()
    found.on_start()
    return found


def test_a_robot_posts_the_datasets_queries_in_turn_with_its_key(robot):
    sent, failures = [], []

    @contextmanager
    def post(path, *, data, headers, catch_response):
        sent.append((path, data, headers))
        assert catch_response
        answer = ({"status": "LOCALIZED", "pose": {}}, {}, {"status": "AMBIGUOUS", "pose": None})[(len(sent) - 1) % 3]
        yield SimpleNamespace(status_code=200, json=lambda: answer, failure=failures.append)

    robot.client = SimpleNamespace(post=post)
    for _ in range(6):
        robot.localize()
    assert {path for path, _, _ in sent} == {"/v1/localize"}
    assert len({data for _, data, _ in sent}) == 5  # the dataset's, then the first again
    assert sent[5][1] == sent[0][1]
    assert all(headers["Authorization"] == "Bearer secret" for _, _, headers in sent)
    assert all(headers["Content-Type"].startswith("multipart/form-data; boundary=") for _, _, headers in sent)
    assert failures == ["no answer"] * 2
