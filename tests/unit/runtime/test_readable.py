"""A mounted file that the user of the service cannot read."""

import os
from pathlib import Path
from typing import Any

import pytest

from service.cli.certificates import Certificates
from service.errors import KeysError, RequestError
from service.runtime.keys import KeyRing
from service.runtime.settings import load_settings


@pytest.fixture
def mounted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a file with mode 600, owned by this user, as user 10001 of the container sees it."""
    path = tmp_path / "keys.txt"
    path.write_text("one " + 64 * "0" + "\n")
    path.chmod(0o600)

    def refused(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr(Path, "read_bytes", refused)
    monkeypatch.setattr(os, "geteuid", lambda: 10001)
    monkeypatch.setattr(os, "getegid", lambda: 10001)
    return path


def read(what: str, path: Path) -> None:
    match what:
        case "keys":
            KeyRing.open(path)
        case "certificate":
            Certificates(path, path, None)
        case _:
            load_settings(path)


@pytest.mark.parametrize("what", ["keys", "certificate", "config"])
def test_the_error_names_user_owner_mode_and_remedy(mounted: Path, what: str) -> None:
    found = mounted.stat()
    with pytest.raises((KeysError, RequestError)) as caught:
        read(what, mounted)
    told = caught.value.message
    assert "runs as user 10001 and group 10001" in told
    assert f"belongs to user {found.st_uid} and group {found.st_gid} with mode 600" in told
    assert f"chown 10001 {mounted}" in told
    assert f"chmod 640 {mounted}" in told


def test_a_parent_folder_without_permission_is_reported(mounted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "stat", refused)
    with pytest.raises(KeysError, match="has no access to a folder"):
        KeyRing.open(mounted)


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(KeysError, match="No such file"):
        KeyRing.open(tmp_path / "nowhere")
