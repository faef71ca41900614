"""What is known of why a bar is missed, by row; written into a report where its row misses. docs/decisions.md has what was tried."""

WHY_MISSED: dict[str, str] = {}
