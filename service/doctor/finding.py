"""The result of one check of ``streetfix doctor``."""

from dataclasses import dataclass
from typing import Literal

from service.errors import StreetfixError

#: A problem stops a service or a query. A warning may make answers worse.
Level = Literal["ok", "warning", "problem"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found.

    Attributes:
        check: name of the check, for example ``depth unit``.
        level: how bad the finding is.
        text: the finding in plain words.
        remedy: what to do; empty if there is nothing to do.
    """

    check: str
    level: Level
    text: str
    remedy: str = ""

    @classmethod
    def of_error(cls, check: str, error: StreetfixError, *, where: str = "", remedy: str = "") -> "Finding":
        """Make a problem of an error. The last clause of its message is the remedy, unless another is given.

        Args:
            check: name of the check.
            error: that the check raised.
            where: file that the message does not name.
            remedy: what to do, if the message does not say.
        """
        text, _, last = error.message.rpartition("; ")
        if remedy or not text:
            text, last = error.message, remedy
        return cls(check, "problem", f"{where}: {text}" if where else text, last)
