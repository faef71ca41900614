from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel, ValidationError

from service.errors import RequestError
from service.runtime.environment import require_known, setting_names
from service.runtime.settings import Limits, Settings, load_settings


def test_the_service_binds_to_loopback_by_default() -> None:
    assert Settings().host == "127.0.0.1"


def test_beyond_loopback_a_service_without_keys_is_refused_with_the_remedies() -> None:
    with pytest.raises(RequestError) as caught:
        load_settings(host="0.0.0.0")  # noqa: S104
    assert caught.value.message.startswith(
        "settings: host 0.0.0.0 can be reached from other machines without a key; set STREETFIX_API_KEYS"
    )
    assert all(f"STREETFIX_{name}" in caught.value.message for name in ("TLS_CLIENT_CA", "INSECURE_PUBLIC=true"))


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
    [
        ("prot = 1", "setting prot"),
        ("port = 70000", "setting port"),
        ("port 9000", "streetfix.toml"),
        (None, "streetfix.toml"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused_with_what_is_wrong(file: Path, text: str | None, says: str) -> None:
    file.unlink()
    if text is not None:
        file.write_text(text)
    with pytest.raises(RequestError, match=says):
        load_settings(file)


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("STREETFIX_THREDS", "STREETFIX_THREADS"),
        ("STREETFIX_APIKEYS", "STREETFIX_API_KEYS"),
        ("STREETFIX_TLS_CERTIFICATES", "STREETFIX_TLS_CERTIFICATE"),
        ("STREETFIX_TLS_CLIENTCA", "STREETFIX_TLS_CLIENT_CA"),
        ("STREETFIX_LIMITS__MAX_PIXEL", "STREETFIX_LIMITS__MAX_PIXELS"),
        ("STREETFIX_LIMITS_MAX_PIXELS", "STREETFIX_LIMITS__MAX_PIXELS"),
        ("STREETFIX_MAP", "STREETFIX_MAPS"),
        ("streetfix_threds", "STREETFIX_THREADS"),
    ],
)
def test_a_misspelt_variable_is_refused_with_the_nearest_name(
    monkeypatch: pytest.MonkeyPatch, name: str, nearest: str
) -> None:
    monkeypatch.setenv(name, "7")
    with pytest.raises(RequestError, match=rf"{name} \(did you mean {nearest}\?\)"):
        load_settings()


def test_a_variable_that_is_near_nothing_is_refused_and_its_value_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_XYZZY", "a secret")
    with pytest.raises(RequestError, match="STREETFIX_XYZZY") as refused:
        load_settings()
    assert "secret" not in refused.value.message


@pytest.mark.parametrize(
    "name",
    ["STREETFIX_CLIENT_CA", "STREETFIX_CLIENT_ANYTHING", "STREETFIX_MAPS_FOLDER", "STREETFIX", "STREETFIXED_THREDS"],
)
def test_variables_of_other_programs_are_left_alone(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "1")
    assert load_settings().threads is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("STREETFIX_PORT", "tcp://10.0.0.1:8000"),
        ("STREETFIX_SERVICE_HOST", "10.0.0.1"),
        ("STREETFIX_SERVICE_PORT_HTTP", "8000"),
        ("STREETFIX_PORT_8000_TCP_ADDR", "10.0.0.1"),
        ("STREETFIX_STREETFIX_PORT_50051_TCP", "tcp://10.0.0.1:50051"),
    ],
)
def test_variables_of_kubernetes_are_recognised(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(RequestError, match=f"{name}.*enableServiceLinks: false"):
        load_settings()


def test_every_setting_can_be_set_by_its_variable() -> None:
    known = {f"STREETFIX_{name.upper().replace('.', '__')}": "" for name in setting_names(Settings)}
    require_known(known, Settings)
    assert {"STREETFIX_PORT", "STREETFIX_LIMITS", "STREETFIX_LIMITS__MAX_PIXELS"} <= set(known)


def test_the_clients_key_is_not_taken_for_the_services_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_API_KEY", "keys.txt")
    with pytest.raises(RequestError, match="STREETFIX_API_KEYS"):
        load_settings()
    assert load_settings(api_keys=Path("keys.txt")).api_keys == Path("keys.txt")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("threds = 7", r"threds: there is no such setting \(did you mean threads\?\)"),
        ("[limits]\nmax_pixel = 7", r"limits.max_pixel: there is no such setting \(did you mean limits.max_pixels\?\)"),
    ],
)
def test_a_misspelt_line_of_the_file_is_refused_with_the_nearest_name(file: Path, text: str, says: str) -> None:
    file.write_text(text)
    with pytest.raises(RequestError, match=says):
        load_settings(file)


@pytest.mark.parametrize(
    "value", ["http://maps.example", "maps.example:8000", "maps/x", "*maps.example", "-", "a,,*.*.b"]
)
def test_an_allowed_host_that_is_no_name_is_refused(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("STREETFIX_ALLOWED_HOSTS", value)
    with pytest.raises(RequestError, match=r"allowed_hosts.*not a valid host name"):
        load_settings()


def test_allowed_hosts_are_joined_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_ALLOWED_HOSTS", "Maps.example, *.robots.example,")
    assert load_settings().allowed_hosts == ("maps.example", "*.robots.example")


def test_every_number_has_a_least_and_a_most() -> None:
    """An infinite timeout, or a limit beyond 32 bits, would fail at the first request."""

    def bounds_of(model: type[BaseModel]) -> Iterator[tuple[str, set[str]]]:
        for name, field in model.model_fields.items():
            kinds = {field.annotation, *get_args(field.annotation)}
            if bool not in kinds and kinds & {int, float}:
                yield name, {key for each in field.metadata for key in ("ge", "gt", "le", "lt") if hasattr(each, key)}

    found = dict([*bounds_of(Settings), *bounds_of(Limits)])
    assert len(found) > 15
    assert [name for name, bounds in found.items() if not (bounds & {"ge", "gt"} and bounds & {"le", "lt"})] == []


@pytest.mark.parametrize("secret", ["hunter2", "0123456789012345678901234567890"])
def test_an_invalid_secret_is_not_shown(monkeypatch: pytest.MonkeyPatch, secret: str) -> None:
    monkeypatch.setenv("STREETFIX_BELIEF_KEY", secret)
    with pytest.raises(RequestError, match="32 random characters or more") as caught:
        load_settings()
    assert secret not in str(caught.value)
    assert caught.value.field == "belief_key"


def test_an_empty_secret_is_none_and_a_valid_one_is_masked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_BELIEF_KEY", "")
    assert load_settings().belief_key is None
    monkeypatch.setenv("STREETFIX_BELIEF_KEY", "s" * 32)
    settings = load_settings()
    assert settings.belief_key is not None
    assert settings.belief_key.get_secret_value() == "s" * 32
    assert "sss" not in settings.model_dump_json()


@pytest.mark.parametrize(
    ("name", "value"),
    [("URL", "http://user:hunter2@host"), ("URL", "ftp://hunter2"), ("COLLECTION", "a/b"), ("TIMEOUT_S", "0")],
)
def test_a_wrong_search_server_is_refused(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(f"STREETFIX_QDRANT_{name}", value)
    with pytest.raises(RequestError, match=f"setting qdrant_{name.lower()}: ") as caught:
        load_settings()
    assert "hunter2" not in str(caught.value)


def test_the_key_of_a_search_server_is_masked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_QDRANT_API_KEY", "")
    monkeypatch.setenv("STREETFIX_QDRANT_URL", "")
    assert (load_settings().qdrant_api_key, load_settings().qdrant_url) == (None, None)
    monkeypatch.setenv("STREETFIX_QDRANT_API_KEY", "hunter2")
    monkeypatch.setenv("STREETFIX_QDRANT_URL", "http://127.0.0.1:6333")
    settings = load_settings()
    assert settings.qdrant_api_key is not None
    assert settings.qdrant_api_key.get_secret_value() == "hunter2"
    assert settings.qdrant_url == "http://127.0.0.1:6333"
    assert "hunter2" not in settings.model_dump_json() + repr(settings)
