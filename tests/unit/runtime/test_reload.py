"""Files that change while the service runs."""

import logging
import threading
from pathlib import Path

import pytest

from service.errors import KeysError
from service.runtime.reload import Reloader
from service.runtime.wakeup import Wakeup


class Loaded:
    """Counts its loads, and fails on demand."""

    def __init__(self) -> None:
        self.times = 0
        self.error: Exception | None = None

    def __call__(self) -> None:
        if self.error is not None:
            raise self.error
        self.times += 1


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_text("1")
    return path


def test_a_changed_file_is_loaded_once(path: Path) -> None:
    loaded, reloader = Loaded(), Reloader()
    reloader.watch("x", [path], loaded)
    reloader.look()
    assert loaded.times == 1
    path.write_text("22")
    reloader.look()
    reloader.look()
    assert loaded.times == 2
    reloader.look(everything=True)
    assert loaded.times == 3


def test_a_link_that_is_turned_counts_as_a_change(path: Path) -> None:
    """Kubernetes replaces all files of a secret at once in this way."""
    (path.parent / "old").mkdir()
    (path.parent / "new").mkdir()
    for name in ("old", "new"):
        (path.parent / name / "key").write_text("same size")
    link, file = path.parent / "..data", path.parent / "key"
    link.symlink_to("old")
    file.symlink_to("..data/key")
    loaded, reloader = Loaded(), Reloader()
    reloader.watch("x", [file], loaded)
    (path.parent / "..tmp").symlink_to("new")
    (path.parent / "..tmp").rename(link)
    reloader.look()
    assert loaded.times == 2


@pytest.mark.parametrize("error", [KeysError("the key file is empty"), OSError("broken")])
def test_an_unusable_file_is_logged_once_and_retried_when_it_changes(
    path: Path, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    loaded, reloader = Loaded(), Reloader()
    reloader.watch("x", [path], loaded)
    loaded.error = error
    path.write_text("bad one")
    with caplog.at_level(logging.WARNING):
        reloader.look()
        reloader.look()
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert "reload_failed name=x" in caplog.text
    loaded.error = None
    path.write_text("a good one")
    reloader.look()
    assert loaded.times == 2


def test_a_file_that_disappears_and_returns_is_loaded(path: Path) -> None:
    loaded, reloader = Loaded(), Reloader()
    reloader.watch("x", [path], loaded)
    path.unlink()
    loaded.error = KeysError("gone")
    reloader.look()
    loaded.error = None
    path.write_text("1")
    reloader.look()
    assert loaded.times == 2


def test_an_unusable_file_at_the_start_is_an_error_for_the_caller(path: Path) -> None:
    loaded = Loaded()
    loaded.error = KeysError("bad")
    with pytest.raises(KeysError):
        Reloader().watch("x", [path], loaded)


def test_one_that_fails_does_not_keep_the_others_back(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("1")
    first, second, reloader = Loaded(), Loaded(), Reloader()
    reloader.watch("first", [path], first)
    reloader.watch("second", [other], second)
    first.error = KeysError("bad")
    path.write_text("bad one")
    other.write_text("22")
    reloader.look()
    assert second.times == 2


def test_a_signal_that_comes_just_after_a_wait_has_timed_out_is_not_lost(path: Path) -> None:
    """The signal requests all files, also those that look unchanged."""

    class SignalledLate(Wakeup):
        waits = 0

        def wait(self, timeout_s: float | None = None) -> bool:
            self.waits += 1
            if self.waits == 1:
                self.set()  # between the end of the wait and what follows it
                return False
            return super().wait(timeout_s)

    again = threading.Event()
    loaded, reloader = Loaded(), Reloader()
    reloader.watch("x", [path], loaded)
    reloader._wake = SignalledLate()
    reloader.watch("y", [path], lambda: again.set() if loaded.times > 1 else None)
    reloader.start(every_s=0)
    assert again.wait(10)
    reloader.stop()
    assert loaded.times == 2
