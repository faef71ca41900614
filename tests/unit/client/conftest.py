from collections.abc import Callable
from typing import Any

import pytest

POSE: dict[str, Any] = {
    "position": {"x": 1.0, "y": 2.0, "z": 3.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    "heading_deg": 90.0,
    "covariance": [0.5] * 36,
}
ANSWER: dict[str, Any] = {
    "status": "LOCALIZED",
    "confidence": 0.75,
    "street": {"id": "s2", "name": "End", "street": "4", "section": "end", "class_index": 6, "vote": 0.5},
    "pose": POSE,
    "vehicle_pose": None,
    "geopose": None,
    "hypotheses": [],
    "spread": None,
    "reasons": [],
    "neighbours": [],
    "map": {"name": "tiny", "version": "abc"},
    "timings_ms": {"decode": 1.0, "fuse": 1.0, "encode": 1.0, "search": 1.0, "register": 1.0, "total": 5.0},
}


@pytest.fixture
def answer_json() -> Callable[..., dict[str, Any]]:
    """Return an accepted answer as the service writes it."""
    return lambda **changed: ANSWER | changed
