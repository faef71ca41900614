"""Explain why the service cannot read a file: its own user, the owner of the file, and the remedy."""

import os
import stat
from pathlib import Path


def why_unreadable(path: Path, error: OSError) -> str:
    """Explain why a file cannot be read.

    For a permission error the text names both users and the remedy. Otherwise it is the message of the system.

    Args:
        path: of the file.
        error: raised when the file was opened.
    """
    if not isinstance(error, PermissionError) or not hasattr(os, "geteuid"):
        return error.strerror or str(error)
    user, group = os.geteuid(), os.getegid()
    who = f"the service runs as user {user} and group {group}"
    try:
        found = path.stat()
    except OSError:
        return f"permission denied: {who}, and has no access to a folder of the path; chmod the folder to 755, or chown it to {user}"
    mode = f"{stat.S_IMODE(found.st_mode):o}"
    return (
        f"permission denied: {who}, and the file belongs to user {found.st_uid} and group {found.st_gid} with mode {mode}; "
        f"chown {user} {path}, or chgrp {group} {path} and chmod 640 {path}"
    )
