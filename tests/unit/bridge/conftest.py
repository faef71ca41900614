from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract.schema import LocalizeAnswer


def header_of(stamp_ns: int, frame_id: str = "optical") -> SimpleNamespace:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)


def image(picture: Any, encoding: str, stamp_ns: int = 0, **changed: Any) -> Any:
    """sensor_msgs/Image of an array, without padding; anything with ROS' fields will do."""
    height, width = picture.shape[:2]
    data = np.ascontiguousarray(picture).tobytes()
    fields = {
        "header": header_of(stamp_ns), "height": height, "width": width, "encoding": encoding,
        "is_bigendian": 0, "step": len(data) // height, "data": data,
    }  # fmt: skip
    return SimpleNamespace(**(fields | changed))


def info(stamp_ns: int = 0, **changed: Any) -> Any:
    """sensor_msgs/CameraInfo of 6 x 4 pixels."""
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {
        "header": header_of(stamp_ns), "height": 4, "width": 6, "d": [], "k": [3.0, 0, 2.5, 0, 3.5, 1.5, 0, 0, 1],
        "p": [0.0] * 12, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**(fields | changed))


@pytest.fixture(scope="session")
def image_of() -> Callable[..., Any]:
    return image


@pytest.fixture(scope="session")
def info_of() -> Callable[..., Any]:
    return info


@pytest.fixture(scope="session")
def answer_of(refused_of: Callable[..., dict[str, Any]]) -> Callable[..., LocalizeAnswer]:
    """A sure answer: a camera at (10, 20, 1.5) that looks along map x; without its pose where another status is given."""

    def made(**changed: Any) -> LocalizeAnswer:
        position = {"x": 10.0, "y": 20.0, "z": 1.5}
        pose = {
            "position": position, "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}, "heading_deg": 0.0,
            "covariance": np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003]).reshape(-1).tolist(),
        }  # fmt: skip
        content = {
            "status": "LOCALIZED", "confidence": 0.95,
            "street": {"id": "s2", "name": "End", "street": "4", "section": "end", "class_index": 6, "vote": 0.5},
            "pose": pose, "vehicle_pose": None, "geopose": None, "hypotheses": [], "spread": None, "reasons": [], "neighbours": [],
            "map": {"name": "tiny", "version": "abc"},
            "timings_ms": {"decode": 1, "fuse": 1, "encode": 1, "search": 1, "register": 1, "total": 5},
        }  # fmt: skip
        if changed.get("status", "LOCALIZED") != "LOCALIZED":
            return LocalizeAnswer.model_validate(refused_of(content, **changed))
        return LocalizeAnswer.model_validate(content | changed)

    return made
