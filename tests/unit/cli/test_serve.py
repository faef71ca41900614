import gc
import socket
from pathlib import Path

import pytest

from service.cli.serve import serve
from service.errors import AddressError, BundleError
from service.runtime.settings import Settings


def test_no_map_is_refused_with_the_remedy() -> None:
    with pytest.raises(BundleError, match="streetfix serve BUNDLE"):
        serve(Settings())


def test_a_damaged_map_is_refused_before_anything_listens(bundle_copy: Path) -> None:
    (bundle_copy / "views.faiss").write_bytes(b"short")
    with pytest.raises(BundleError, match=r"views\.faiss: it has 5 bytes"):
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
    """A full collection over all modules stops a service for 100 ms; a replaced map must not be kept by it."""
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
