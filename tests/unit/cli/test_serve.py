import gc
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cli.serve import check_only, command, serve
from service.errors import AddressError, BundleError
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.settings import Settings


def test_no_map_is_refused_with_the_remedy() -> None:
    with pytest.raises(BundleError, match="streetfix serve BUNDLE"):
        serve(Settings())


def test_a_damaged_map_is_refused_before_anything_listens(bundle_copy: Path) -> None:
    (bundle_copy / "descriptors.npy").write_bytes(b"short")
    with pytest.raises(BundleError, match=r"descriptors\.npy: 5 bytes instead of"):
        serve(Settings(maps=(bundle_copy,)))


def test_a_taken_address_is_refused_with_the_remedy(bundle_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(AddressError, match=rf"127\.0\.0\.1:{port} .*choose another --host or --port"):
            serve(Settings(maps=(bundle_path,), port=port))


def test_an_address_that_is_not_this_machines_is_refused(bundle_path: Path) -> None:
    with pytest.raises(AddressError):
        serve(Settings(maps=(bundle_path,), host="203.0.113.7", insecure_public=True))


def test_garbage_collection_passes_over_what_was_imported_but_not_over_maps(
    bundle_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full collection over all modules would stop the service for 100 ms. A replaced map must still be freed."""
    frozen: list[int] = []

    def opening(*_: object, **__: object) -> None:
        frozen.append(gc.get_freeze_count())
        raise RuntimeError("no further")

    monkeypatch.setattr("service.runtime.engine.Engine.open", opening)
    before = gc.get_freeze_count()
    with pytest.raises(RuntimeError, match="no further"):
        serve(Settings(maps=(bundle_path,), port=0))
    assert frozen[0] > 50_000
    assert gc.get_freeze_count() in (0, before)


def test_no_garbage_is_collected_between_the_imports_and_the_maps(
    bundle_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fifth of the time of the imports was collection. Afterwards it is on again, also after an error."""
    collects: dict[str, bool] = {}

    def opening(*_: object, **__: object) -> None:
        collects["while maps open"] = gc.isenabled()
        raise RuntimeError("no further")

    monkeypatch.setattr(
        "service.runtime.logs.set_up", lambda **_: collects.update({"after the imports": gc.isenabled()})
    )
    monkeypatch.setattr("service.runtime.engine.Engine.open", opening)
    with pytest.raises(RuntimeError, match="no further"):
        serve(Settings(maps=(bundle_path,), port=0))
    assert collects == {"after the imports": False, "while maps open": True}
    assert gc.isenabled()


def test_check_collects_garbage_while_maps_open(bundle_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collects: list[bool] = []

    def opening(*_: object, **__: object) -> None:
        collects.append(gc.isenabled())
        raise RuntimeError("no further")

    monkeypatch.setattr("service.runtime.engine.Engine.open", opening)
    with pytest.raises(RuntimeError, match="no further"):
        command(maps=[str(bundle_path)], check=True)
    assert collects == [True]


def test_check_names_every_bundle_that_cannot_be_mounted(
    bundle_copy: Path, content_of: Callable[..., BundleContent], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (bundle_copy / "descriptors.npy").write_bytes(b"short")
    write_bundle(tmp_path / "good", content_of(name="good"))
    with pytest.raises(
        BundleError, match=r"1 of the map bundles cannot be mounted: own/descriptors\.npy: 5 bytes instead of"
    ):
        check_only(Settings(maps=(tmp_path,)))
    assert "map good" in capsys.readouterr().out


def test_check_refuses_a_rate_of_false_accepts_that_a_map_cannot_promise(
    content_of: Callable[..., BundleContent], calibration_json: Callable[..., object], tmp_path: Path
) -> None:
    write_bundle(tmp_path / "m", content_of(calibration=calibration_json()))
    check_only(Settings(maps=(tmp_path / "m",), false_accept_rate=0.001))
    for act in (check_only, serve):
        with pytest.raises(
            BundleError, match=r"false_accept_rate is 1e-05, but the calibration of this map supports 0\.001"
        ):
            act(Settings(maps=(tmp_path / "m",), port=0, false_accept_rate=1e-5))


def test_check_of_an_empty_maps_folder_says_that_the_service_would_wait(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_only(Settings(maps=(tmp_path,)))
    assert (
        f"no map yet: not ready (/readyz answers 503) until there is a map bundle in {tmp_path}"
        in capsys.readouterr().out
    )
    with pytest.raises(BundleError, match="no map bundle found in"):
        check_only(Settings(maps=(tmp_path,), strict=True))


def test_a_sighup_during_the_start_waits_for_its_handler(bundle_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By default, SIGHUP would end the process."""
    blocked: list[bool] = []

    def opening(*_: object, **__: object) -> None:
        blocked.append(signal.SIGHUP in signal.pthread_sigmask(signal.SIG_BLOCK, ()))
        raise RuntimeError("no further")

    monkeypatch.setattr("service.runtime.engine.Engine.open", opening)
    with pytest.raises(RuntimeError, match="no further"):
        serve(Settings(maps=(bundle_path,), port=0))
    assert blocked == [True]
    assert signal.SIGHUP not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
