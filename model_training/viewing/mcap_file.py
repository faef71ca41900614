"""Events as an MCAP file with Foxglove's schemas, for Foxglove, Lichtblick and other readers."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.viewing.events import Cloud, Event, Note, Outlines, Poses, Track, View, millimetres
from service.geometry.rigid import quaternion_xyzw_from

_MAP, _CAMERA = "map", "camera"
_LINE_M = 0.15
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<u1")])


def write_mcap(events: Iterable[Event], path: Path) -> int:
    """Write events atomically and return their number. Events that are always visible have time 0.

    Args:
        events: events in their order.
        path: file to write.
    """
    from foxglove import Context, open_mcap  # an extra that only this command needs

    part = path.with_name(path.name + ".part")
    part.parent.mkdir(parents=True, exist_ok=True)
    context, channels, count = Context(), dict[str, Any](), 0
    with open_mcap(part, allow_overwrite=True, context=context):
        for event in events:
            at_ns = round((event.stamp_s or 0.0) * 1e9)
            for topic, message in _messages(event, at_ns):
                if topic not in channels:
                    channels[topic] = _channel(topic, message, context)
                channels[topic].log(message, log_time=at_ns)
            count += 1
    part.rename(path)
    return count


def _channel(topic: str, message: Any, context: Any) -> Any:
    from foxglove import channels

    return getattr(channels, f"{type(message).__name__}Channel")(topic, context=context)


def _messages(event: Event, at_ns: int) -> list[tuple[str, Any]]:
    from foxglove import messages as fm

    stamp = fm.Timestamp(sec=at_ns // 10**9, nsec=at_ns % 10**9)
    topic = f"/{event.topic}"
    match event:
        case Cloud():
            return [(topic, _cloud(fm, event, stamp))]
        case Track():
            return [(topic, _lines(fm, event.topic, [event.positions_m], stamp))]
        case Outlines():
            return [(topic, _lines(fm, event.topic, event.rings_m, stamp))]
        case Poses():
            poses = [_pose(fm, T) for T in event.T_map_camera]
            return [(topic, fm.PosesInFrame(timestamp=stamp, frame_id=_MAP, poses=poses))]
        case Note():
            level = fm.LogLevel.Info if event.good else fm.LogLevel.Warning
            return [(topic, fm.Log(timestamp=stamp, level=level, message=event.text, name="streetfix"))]
        case View():
            return _view(fm, event, stamp)


def _cloud(fm: Any, cloud: Cloud, stamp: Any) -> Any:
    packed = np.empty(len(cloud.points_m), _POINT)
    packed["x"], packed["y"], packed["z"] = cloud.points_m.T
    packed["intensity"] = cloud.grey
    numeric = fm.PackedElementFieldNumericType
    kinds = (("x", numeric.Float32), ("y", numeric.Float32), ("z", numeric.Float32), ("intensity", numeric.Uint8))
    fields = [fm.PackedElementField(name=name, offset=4 * k, type=kind) for k, (name, kind) in enumerate(kinds)]
    pose, data = _pose(fm, _at(cloud.origin_m)), packed.tobytes()
    return fm.PointCloud(
        timestamp=stamp, frame_id=_MAP, pose=pose, point_stride=_POINT.itemsize, fields=fields, data=data
    )


def _lines(fm: Any, name: str, strips_m: Iterable[NDArray[np.float64]], stamp: Any) -> Any:
    """Return an update that replaces the entity of its name; an empty update removes the last line."""
    lines = [
        fm.LinePrimitive(
            type=fm.LinePrimitiveLineType.LineStrip,
            pose=_pose(fm, _at(np.zeros(3))),
            thickness=_LINE_M,
            points=[fm.Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in strip],
            color=fm.Color(r=0.9, g=0.5, b=0.1, a=1.0),
        )
        for strip in strips_m
        if len(strip)
    ]
    return fm.SceneUpdate(entities=[fm.SceneEntity(timestamp=stamp, frame_id=_MAP, id=name, lines=lines)])


def _view(fm: Any, view: View, stamp: Any) -> list[tuple[str, Any]]:
    camera, T = view.camera, view.T_map_camera
    position, q = T[:3, 3], quaternion_xyzw_from(T[:3, :3])
    moved = fm.FrameTransform(
        timestamp=stamp,
        parent_frame_id=_MAP,
        child_frame_id=_CAMERA,
        translation=fm.Vector3(x=float(position[0]), y=float(position[1]), z=float(position[2])),
        rotation=fm.Quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3])),
    )
    K = [float(value) for value in camera.matrix.ravel()]
    projection = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    calibration = fm.CameraCalibration(
        timestamp=stamp,
        frame_id=_CAMERA,
        width=camera.width,
        height=camera.height,
        K=K,
        R=[1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0],
        P=projection,
    )
    depth_mm = millimetres(view.depth_m).astype("<u2")
    height, width = depth_mm.shape
    depth = fm.RawImage(
        timestamp=stamp,
        frame_id=_CAMERA,
        width=width,
        height=height,
        encoding="16UC1",
        step=2 * width,
        data=depth_mm.tobytes(),
    )
    return [
        ("/tf", fm.FrameTransforms(transforms=[moved])),
        (f"/{view.topic}/calibration", calibration),
        (
            f"/{view.topic}/colour",
            fm.CompressedImage(timestamp=stamp, frame_id=_CAMERA, data=view.colour_jpeg, format="jpeg"),
        ),
        (f"/{view.topic}/depth", depth),
        (
            f"/{view.topic}/fused",
            fm.CompressedImage(timestamp=stamp, frame_id=_CAMERA, data=view.fused_jpeg, format="jpeg"),
        ),
    ]


def _pose(fm: Any, T: NDArray[np.float64]) -> Any:
    q = quaternion_xyzw_from(T[:3, :3])
    return fm.Pose(
        position=fm.Vector3(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
        orientation=fm.Quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3])),
    )


def _at(position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, 3] = position_m
    return T
