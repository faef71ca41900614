"""Events for Rerun: to a file, or to a viewer on this screen."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from model_training.viewing.events import Cloud, Event, Note, Outlines, Poses, Track, View, millimetres

_TIMELINE = "time"
#: Colours of poses by topic; others are grey.
_COLOURS = {
    "query/truth": (40, 180, 110),
    "answer/pose": (220, 60, 50),
    "answer/registered": (240, 160, 40),
    "answer/hypotheses": (80, 140, 230),
    "answer/neighbours": (140, 140, 140),
}
_GREY, _AXIS_M = (140, 140, 140), 2.0


def write_rerun(events: Iterable[Event], path: Path | None) -> int:
    """Log events and return their number.

    Args:
        events: events in their order.
        path: file to write atomically; None starts a viewer.
    """
    import rerun as rr  # an extra of 500 MB that only this command needs

    recording = rr.RecordingStream("streetfix")
    part = None if path is None else path.with_name(path.name + ".part")
    if part is None:
        recording.spawn()
    else:
        part.parent.mkdir(parents=True, exist_ok=True)
        recording.save(part)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    count = 0
    for event in events:
        if event.stamp_s is not None:
            recording.set_time(_TIMELINE, duration=event.stamp_s)
        for entity, content in _drawn(rr, event):
            recording.log(entity, content, static=event.stamp_s is None)
        count += 1
    recording.flush()
    recording.disconnect()
    if part is not None and path is not None:
        part.rename(path)
    return count


def _drawn(rr: Any, event: Event) -> list[tuple[str, Any]]:
    match event:
        case Cloud():
            colours = np.repeat(event.grey[:, None], 3, axis=1)
            return [
                (event.topic, rr.Transform3D(translation=event.origin_m)),
                (f"{event.topic}/points", rr.Points3D(event.points_m, colors=colours)),
            ]
        case Track():
            return [(event.topic, rr.LineStrips3D([event.positions_m] if len(event.positions_m) else []))]
        case Outlines():
            return [(event.topic, rr.LineStrips3D(list(event.rings_m), labels=list(event.names), show_labels=False))]
        case View():
            return _view(rr, event)
        case Poses():
            origins, ahead = event.T_map_camera[:, :3, 3], event.T_map_camera[:, :3, 2]
            colour = _COLOURS.get(event.topic, _GREY)
            return [(event.topic, rr.Arrows3D(origins=origins, vectors=_AXIS_M * ahead, colors=[colour]))]
        case Note():
            return [(event.topic, rr.TextLog(event.text, level="INFO" if event.good else "WARN"))]


def _view(rr: Any, view: View) -> list[tuple[str, Any]]:
    camera, T = view.camera, view.T_map_camera
    pinhole = rr.Pinhole(
        focal_length=(camera.fx, camera.fy),
        principal_point=(camera.cx + 0.5, camera.cy + 0.5),  # rerun counts from the corner
        width=camera.width,
        height=camera.height,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_AXIS_M,
    )
    return [
        (view.topic, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])),
        (f"{view.topic}/picture", pinhole),
        (f"{view.topic}/picture/colour", rr.EncodedImage(contents=view.colour_jpeg, media_type="image/jpeg")),
        (f"{view.topic}/picture/depth", rr.DepthImage(millimetres(view.depth_m), meter=1000.0)),
        ("query/fused", rr.EncodedImage(contents=view.fused_jpeg, media_type="image/jpeg")),
    ]
