from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel, ValidationError

from service.errors import RequestError
from service.runtime.settings import Limits, Settings, load_settings


def test_the_service_binds_to_loopback_unless_told_otherwise() -> None:
    assert Settings().host == "127.0.0.1"


def test_the_environment_goes_above_defaults_and_flags_above_both(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_PORT", "9000")
    monkeypatch.setenv("STREETFIX_QUEUE", "3")
    settings = load_settings(port=9001, host=None)
    assert (settings.port, settings.queue, settings.host) == (9001, 3, "127.0.0.1")


def test_limits_are_nested_by_two_underscores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_LIMITS__MAX_PIXELS", "1000")
    assert load_settings().limits.max_pixels == 1000


def test_maps_are_joined_by_colons_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_MAPS", "/maps/a:/maps/b")
    assert load_settings().maps == (Path("/maps/a"), Path("/maps/b"))


def test_a_value_that_makes_no_sense_is_refused_with_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_PORT", "70000")
    with pytest.raises(RequestError, match=r"setting port: .*70000"):
        load_settings()


def test_an_unknown_setting_is_refused() -> None:
    with pytest.raises(RequestError, match="setting prot"):
        load_settings(prot=1)


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValidationError):
        Settings().port = 1  # type: ignore[misc]  # that is the point


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "streetfix.toml"
    path.write_text('port = 9000\nqueue = 3\nmaps = ["/maps/a", "/maps/b"]\n[limits]\nmax_pixels = 1000\n')
    return path


def test_a_file_goes_below_the_environment_and_flags(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_QUEUE", "4")
    settings = load_settings(file, port=9001)
    assert (settings.port, settings.queue, settings.limits.max_pixels) == (9001, 4, 1000)
    assert settings.maps == (Path("/maps/a"), Path("/maps/b"))
    assert settings.host == "127.0.0.1"
    assert type(settings) is Settings


def test_the_environment_may_name_the_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_CONFIG", str(file))
    assert load_settings().port == 9000


@pytest.mark.parametrize(
    ("text", "says"),
    [("prot = 1", "setting prot"), ("port = 70000", "setting port"), ("port 9000", "streetfix.toml"), (None, "streetfix.toml")],
)  # fmt: skip
def test_a_file_that_makes_no_sense_is_refused_with_what_is_wrong(file: Path, text: str | None, says: str) -> None:
    file.unlink()
    if text is not None:
        file.write_text(text)
    with pytest.raises(RequestError, match=says):
        load_settings(file)


def test_every_number_has_a_least_and_a_most() -> None:
    """An endless timeout, or a limit that gRPC's 32 bits do not hold, would fail at the first request."""

    def bounds_of(model: type[BaseModel]) -> Iterator[tuple[str, set[str]]]:
        for name, field in model.model_fields.items():
            kinds = {field.annotation, *get_args(field.annotation)}
            if bool not in kinds and kinds & {int, float}:
                yield name, {key for each in field.metadata for key in ("ge", "gt", "le", "lt") if hasattr(each, key)}

    found = dict([*bounds_of(Settings), *bounds_of(Limits)])
    assert len(found) > 15
    assert [name for name, bounds in found.items() if not (bounds & {"ge", "gt"} and bounds & {"le", "lt"})] == []
