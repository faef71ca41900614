"""The OSCP GeoPose Protocol, version 2: its messages, of which clients leave out or send as null what they please.

Facts after github.com/OpenArCloud/oscp-geopose-protocol (README, November 2026). What it leaves open is settled here:

- Intrinsics are COLMAP's, so the corner of the first pixel is (0, 0); ours puts its centre there.
- A DEPTH image of integers holds millimetres; of floats metres. ``minMaxDepth`` ends what counts as measured.
- An accuracy of 0, or of more than ``_MOST_STD_M``, is not known: the clients' own structures begin with 0 and with the largest float.
- The accelerometer is W3C's: x right, y up, z towards the viewer, and at rest it points up; the camera looks the other way.
"""

import base64
import binascii
import sys
from math import atan2, degrees
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from service.contract import schema
from service.contract.convert import checked, query_from
from service.errors import DecodeError, NotYetSupportedError, RequestError
from service.geometry.rigid import rotation_from_quaternion_xyzw
from service.runtime.engine import EncodedQuery

#: How many numbers a camera model has: focal lengths, principal point, distortion.
_MODELS = {
    "SIMPLE_PINHOLE": (1, 0), "PINHOLE": (2, 0), "SIMPLE_RADIAL": (1, 1), "RADIAL": (1, 2), "OPENCV": (2, 4), "FULL_OPENCV": (2, 8),
}  # fmt: skip
_COLOUR = ("RGBA32", "RGB", "JPG", "GRAY8")
_MOST_READINGS = 64
_SAME_VIEW = 0.01  # of the picture's size
#: Of a prior pose whose accuracy was not told, or told too well: its sender has moved since.
_LEAST_STD_M, _MOST_STD_M, _HEADING_STD_DEG = 5.0, 1e5, 30.0

#: Bounds of what clients send. What our own contract bounds more narrowly is refused there, by its name there.
_Pixels = Annotated[float, Field(ge=-schema.MOST_COMPONENT, le=schema.MOST_COMPONENT)]
_Side = Annotated[float, Field(ge=0, le=schema.MOST_SIDE)]
_Metres = Annotated[float, Field(ge=0, le=1e5)]
_Component = Annotated[float, Field(ge=-schema.MOST_COMPONENT, le=schema.MOST_COMPONENT)]
#: -1 is iOS' word for not known, the largest float that of the clients' own structures.
_Deviation = Annotated[float, Field(ge=-1, le=sys.float_info.max)]
_Latitude = Annotated[float, Field(ge=-90, le=90)]
_Longitude = Annotated[float, Field(ge=-180, le=180)]


class _Lenient(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class CameraParams(_Lenient):
    """Intrinsics."""

    model: str | None = None
    modelParams: list[_Pixels] | None = Field(None, max_length=32)
    minMaxDepth: list[_Metres] | None = Field(None, max_length=2)


class ImageOrientation(_Lenient):
    """How the picture lies in its bytes."""

    mirrored: bool | None = None
    rotation: float | None = Field(None, ge=-360, le=360, description="degrees")


class CameraReading(_Lenient):
    """A picture."""

    sensorId: str | None = None
    imageFormat: str | None = Field(
        None, description="RGBA32, JPG or GRAY8 for colour, whatever the file's own format; DEPTH for depth"
    )
    size: list[_Side] | None = Field(None, max_length=2, description="width, height")
    imageBytes: str | None = Field(None, description="base64 of an encoded picture, with or without a data: prefix")
    imageOrientation: ImageOrientation | None = None
    params: CameraParams | None = None


class GeolocationReading(_Lenient):
    """What a satellite receiver says."""

    latitude: _Latitude | None = None
    longitude: _Longitude | None = None
    accuracy: _Deviation | None = None


class AccelerometerReading(_Lenient):
    """Specific force."""

    x: _Component | None = None
    y: _Component | None = None
    z: _Component | None = None


class SensorReadings(_Lenient):
    """All that a client has read; other kinds are passed over."""

    cameraReadings: list[CameraReading] | None = Field(None, max_length=_MOST_READINGS)
    geolocationReadings: list[GeolocationReading] | None = Field(None, max_length=_MOST_READINGS)
    accelerometerReadings: list[AccelerometerReading] | None = Field(None, max_length=_MOST_READINGS)


class Accuracy(_Lenient):
    """Standard deviations: position m, mean of the components; orientation degrees, mean of the three angles."""

    position: float | None = None
    orientation: float | None = None


class EarlierAccuracy(_Lenient):
    """Of an earlier answer, as ``Accuracy``."""

    position: _Deviation | None = None
    orientation: _Deviation | None = None


class EarlierPosition(_Lenient):
    """Of an earlier answer, on the WGS-84 ellipsoid."""

    lat: _Latitude = Field(description="degrees")
    lon: _Longitude = Field(description="degrees")
    h: float = Field(ge=-1e5, le=1e5, description="metres above the ellipsoid")


class EarlierGeoPose(_Lenient):
    """An earlier answer's pose."""

    position: EarlierPosition
    quaternion: schema.Quaternion


class PriorPose(_Lenient):
    """An earlier answer."""

    accuracy: EarlierAccuracy | None = None
    geopose: EarlierGeoPose | None = None


class GeoPoseRequest(_Lenient):
    """A request."""

    id: str | None = Field(None, max_length=256)
    timestamp: float | None = Field(
        None, ge=0, le=1e19, description="Unix ms; finer units pass, since nothing reads it"
    )
    type: str | None = None
    sensorReadings: SensorReadings | None = None
    priorPoses: list[PriorPose] | None = Field(None, max_length=_MOST_READINGS)


class GeoPoseAnswer(BaseModel):
    """An answer; the quaternion leads from east, north, up to the camera's axes: x right, y down, z forward."""

    id: str
    timestamp: int = Field(description="Unix ms")
    type: Literal["geopose"] = "geopose"
    accuracy: Accuracy
    geopose: schema.GeoPose


def query_of(request: GeoPoseRequest, map_name: str | None) -> EncodedQuery:
    """The core's query.

    Raises:
        RequestError: a reading is missing or makes no sense; RGB alone lacks its DEPTH.
        NotYetSupportedError: a distorted, mirrored or turned picture.
    """
    readings = request.sensorReadings or SensorReadings()
    where = "sensorReadings.cameraReadings"
    colour = _reading(
        readings, _COLOUR, f"{where}: there is no colour picture (imageFormat RGBA32); send one beside its DEPTH"
    )
    depth = _reading(
        readings, ("DEPTH",),
        f"{where}: there is no picture of imageFormat DEPTH; this service localizes by colour and depth together: send the depth "
        "camera's picture (16-bit PNG in mm, or float TIFF in m) as a second reading",
    )  # fmt: skip
    _require_same_view(colour, depth)
    content: dict[str, Any] = {"map": map_name, "camera": _camera(colour), "depth": _depth_format(depth)}
    if gravity := _gravity(readings):
        content["gravity"] = gravity
    if prior := _prior(request, readings):
        content["prior"] = prior
    return query_from(
        checked(content, schema.LocalizeRequest),
        rgb=_bytes(colour, f"{where}.rgb.imageBytes"), depth=_bytes(depth, f"{where}.depth.imageBytes"),
    )  # fmt: skip


def accuracy_of(covariance: list[float] | None) -> Accuracy:
    """Means of the standard deviations; nothing where they are not known."""
    if covariance is None:
        return Accuracy()
    sigma = np.sqrt(np.diag(np.array(covariance).reshape(6, 6)))
    return Accuracy(position=float(sigma[:3].mean()), orientation=float(np.rad2deg(sigma[3:]).mean()))


def _reading(readings: SensorReadings, formats: tuple[str, ...], missing: str) -> CameraReading:
    found = [each for each in readings.cameraReadings or () if (each.imageFormat or "").upper() in formats]
    if not found:
        raise RequestError(missing, field="sensorReadings.cameraReadings")
    latest = found[-1]
    turned = latest.imageOrientation
    if turned is not None and (turned.mirrored or (turned.rotation or 0) % 360):
        raise NotYetSupportedError(
            "sensorReadings.cameraReadings.imageOrientation: this release reads upright, unmirrored pictures only; turn them before",
            field="sensorReadings.cameraReadings.imageOrientation",
        )
    return latest


def _camera(reading: CameraReading) -> dict[str, Any]:
    """The contract's camera from COLMAP's numbers."""
    where = "sensorReadings.cameraReadings.params"
    params = reading.params or CameraParams()
    model, numbers = (params.model or "").upper(), params.modelParams or []
    if model not in _MODELS or len(numbers) != _MODELS[model][0] + 2 + _MODELS[model][1]:
        raise RequestError(
            f"{where}: {len(numbers)} numbers of model {model or 'none'}; send COLMAP's parameters of one of {', '.join(_MODELS)}",
            field=where,
        )
    if reading.size is None or len(reading.size) != 2:
        raise RequestError(
            "sensorReadings.cameraReadings.size: width and height are missing",
            field="sensorReadings.cameraReadings.size",
        )
    focal = _MODELS[model][0]
    fx, fy = numbers[0], numbers[focal - 1]
    cx, cy = numbers[focal : focal + 2]
    return {
        "width": int(reading.size[0]), "height": int(reading.size[1]), "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5,
        "distortion": numbers[focal + 2 :],
    }  # fmt: skip


def _require_same_view(colour: CameraReading, depth: CameraReading) -> None:
    """Depth is read by the colour camera's intrinsics, so it must be aligned with it; another camera's is refused, not misread."""
    if depth.params is None or not depth.params.modelParams:
        return
    one, other = _camera(colour), _camera(depth)
    for focal, size in (("fx", "width"), ("fy", "height"), ("cx", "width"), ("cy", "height")):
        if abs(one[focal] / max(one[size], 1) - other[focal] / max(other[size], 1)) > _SAME_VIEW:
            raise NotYetSupportedError(
                f"sensorReadings.cameraReadings.depth.params: its {focal} is another than the colour camera's; send depth aligned with "
                "the colour picture", field="sensorReadings.cameraReadings.depth.params",
            )  # fmt: skip


def _depth_format(reading: CameraReading) -> dict[str, Any]:
    limits = None if reading.params is None else reading.params.minMaxDepth
    return {"max_range_m": limits[1]} if limits and len(limits) == 2 and limits[1] > 0 else {}


def _bytes(reading: CameraReading, field: str) -> bytes:
    text = reading.imageBytes or ""
    if text.startswith("data:"):
        text = text.partition(",")[2]
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise DecodeError(f"{field}: it is no base64; encode the whole picture file", field=field) from error


def _gravity(readings: SensorReadings) -> dict[str, float] | None:
    """Down in the camera's axes."""
    for each in reversed(readings.accelerometerReadings or []):
        if each.x is not None and each.y is not None and each.z is not None and (each.x, each.y, each.z) != (0, 0, 0):
            return {"x": -each.x, "y": each.y, "z": each.z}
    return None


def _prior(request: GeoPoseRequest, readings: SensorReadings) -> dict[str, Any] | None:
    """Of the latest earlier pose, else of the satellite receiver."""
    for pose in reversed(request.priorPoses or []):
        if pose.geopose is not None:
            at, q = pose.geopose.position, pose.geopose.quaternion
            told = None if pose.accuracy is None else pose.accuracy.position
            optical = (
                rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]))[:, 2]
                if any((q.x, q.y, q.z, q.w))
                else None
            )
            prior: dict[str, Any] = {"wgs84": _place(at.lat, at.lon, told)}
            if optical is not None and np.hypot(optical[0], optical[1]) > 0.1:
                prior |= {"heading_deg": degrees(atan2(optical[1], optical[0])), "heading_std_deg": _HEADING_STD_DEG}
            return prior
    for reading in reversed(readings.geolocationReadings or []):
        if reading.latitude is not None and reading.longitude is not None:
            return {"wgs84": _place(reading.latitude, reading.longitude, reading.accuracy)}
    return None


def _place(latitude_deg: float, longitude_deg: float, std_m: float | None) -> dict[str, float]:
    std: float = schema.PriorWgs84.model_fields["std_m"].default
    if std_m is not None and 0 < std_m <= _MOST_STD_M:
        std = max(std_m, _LEAST_STD_M)
    return {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "std_m": std}
