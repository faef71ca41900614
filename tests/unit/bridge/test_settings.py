"""Settings of the bridge: the options of the command and the parameters of the ROS node come from one list."""

import inspect
from dataclasses import fields
from pathlib import Path

import pytest

from service.bridge.bridge import Bridge, Topics
from service.bridge.pairs import Pairs
from service.bridge.publish_policy import PublishPolicy
from service.bridge.settings import BridgeSettings, about, parameters, settings_from
from service.cli.bridge import ros2

NAMES = [each.name for each in fields(BridgeSettings)]


def test_the_settings_are_the_options_of_the_command_with_their_defaults() -> None:
    options = {
        {"map_bundle": "map"}.get(name, name): each.default for name, each in inspect.signature(ros2).parameters.items()
    }
    assert {name: getattr(BridgeSettings(), name) for name in NAMES} == {
        name: default for name, default in options.items() if name not in ("domain", "node")
    }


def test_the_defaults_are_those_of_the_bridge() -> None:
    told, topics, policy = BridgeSettings(), Topics(), PublishPolicy()
    assert (told.color_topic, told.depth_topic, told.info_topic) == (topics.color, topics.depth, topics.info)
    assert (told.pose_topic, told.diagnostics_topic) == (topics.pose, topics.diagnostics)
    assert (told.rate, told.min_confidence) == (policy.rate_hz, policy.min_confidence)
    assert told.tolerance == inspect.signature(Pairs).parameters["tolerance_s"].default
    bridge = inspect.signature(Bridge).parameters
    assert (told.frame, told.rectified) == (bridge["frame_id"].default, bridge["rectified"].default)


def test_every_setting_says_what_it_means() -> None:
    assert about("rate") == "Largest number of queries per second. 0 sends one for every pair."
    assert all(about(name).endswith(".") for name in NAMES)


def test_a_parameter_has_the_type_of_its_setting_and_an_empty_text_for_none() -> None:
    declared = parameters()
    assert list(declared) == NAMES
    assert [name for name, value in declared.items() if value == ""] == [
        "map",
        "map_name",
        "api_key",
        "ca",
        "cert",
        "key",
        "mount",
        "right_info_topic",
    ]
    assert (declared["rate"], declared["rectified"], declared["queue"]) == (1.0, False, 5)


def test_the_default_parameters_are_the_default_settings() -> None:
    assert settings_from(parameters(), environ={}) == BridgeSettings()


def test_parameters_that_are_given_become_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/robot")
    given: dict[str, str | float | int | bool] = {
        "map": "~/maps/site",
        "mount": "0,0,0,0,0,0,1",
        "rate": 0.0,
        "rectified": True,
        "frame": "earth",
    }
    assert settings_from(parameters() | given, environ={}) == BridgeSettings(
        map=Path("/home/robot/maps/site"), mount="0,0,0,0,0,0,1", rate=0.0, rectified=True, frame="earth"
    )


@pytest.mark.parametrize(("given", "wanted"), [("", "of the environment"), ("own", "own")])
def test_the_key_of_the_environment_stands_in_for_none(given: str, wanted: str) -> None:
    environ = {"STREETFIX_API_KEY": "of the environment"}
    assert settings_from(parameters() | {"api_key": given}, environ).api_key == wanted


def test_a_text_that_must_be_there_stays_empty() -> None:
    """An empty topic stays empty, so ROS reports the error. It does not select the default."""
    assert settings_from(parameters() | {"color_topic": ""}, environ={}).color_topic == ""
