"""Warnings for the operator. Each text appears once."""


class Notices:
    """Collects warnings until somebody takes them."""

    def __init__(self) -> None:
        self._known: set[str] = set()
        self._waiting: list[str] = []

    def warn(self, text: str) -> None:
        """Add a warning, unless it was added before.

        Args:
            text: what is wrong, what follows from it, and the remedy.
        """
        if text not in self._known:
            self._known.add(text)
            self._waiting.append(text)

    def take(self) -> tuple[str, ...]:
        """Return the warnings since the last call."""
        taken = tuple(self._waiting)
        self._waiting.clear()
        return taken
