"""Messages of the OSCP GeoPose Protocol, version 2. Clients may omit any field or send null for it.

Source: github.com/OpenArCloud/oscp-geopose-protocol (README, November 2026). This module settles what the protocol leaves open:

- Intrinsics follow COLMAP: the corner of the first pixel is (0, 0). In our contract, its centre is (0, 0). COLMAP's fisheye models
  are those of Kannala and Brandt with one, two or four coefficients, its others those of Brown and Conrady.
- A DEPTH image of integers holds millimetres, one of floats holds metres. Depth beyond the
  maximum of ``minMaxDepth`` counts as not measured.
- An accuracy of 0, or above ``_MOST_STD_M``, means unknown. The clients' structures start with 0 and with the largest float.
- ``heightAboveGround`` and ``heightAboveGroundAccuracy`` of a camera's parameters are our own fields. The protocol has none.
- The accelerometer follows W3C: x right, y up, z towards the viewer. At rest it points up. The camera looks the other way.
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
from service.geometry.camera import DistortionModel
from service.geometry.rigid import rotation_from_quaternion_xyzw
from service.option_limits import LEAST_HEIGHT_M, LEAST_HEIGHT_STD_M, MOST_HEIGHT_M, MOST_HEIGHT_STD_M
from service.runtime.engine import EncodedQuery

#: Number of focal lengths and of distortion coefficients per camera model, and our model of the lens. The principal point has two numbers
#: in each model. All coefficients have OpenCV's order.
_MODELS: dict[str, tuple[int, int, DistortionModel]] = {
    "SIMPLE_PINHOLE": (1, 0, "brown_conrady"),
    "PINHOLE": (2, 0, "brown_conrady"),
    "SIMPLE_RADIAL": (1, 1, "brown_conrady"),
    "RADIAL": (1, 2, "brown_conrady"),
    "OPENCV": (2, 4, "brown_conrady"),
    "FULL_OPENCV": (2, 8, "brown_conrady"),
    "SIMPLE_RADIAL_FISHEYE": (1, 1, "kannala_brandt"),
    "RADIAL_FISHEYE": (1, 2, "kannala_brandt"),
    "OPENCV_FISHEYE": (2, 4, "kannala_brandt"),
}
#: Fewest coefficients of either model in our contract.
_COEFFICIENTS = 4
_COLOUR = ("RGBA32", "RGB", "JPG", "GRAY8")
_MOST_READINGS = 64
_SAME_VIEW = 0.01  # of the image size
#: Standard deviations of a prior pose with an unknown or too small accuracy. Its sender has moved since.
_LEAST_STD_M, _MOST_STD_M, _HEADING_STD_DEG = 5.0, 1e5, 30.0

#: Limits of the numbers that clients send. Our own contract has narrower limits for some. It refuses them under its own field names.
_Pixels = Annotated[float, Field(ge=-schema.MOST_COMPONENT, le=schema.MOST_COMPONENT)]
_Side = Annotated[float, Field(ge=0, le=schema.MOST_SIDE)]
_Metres = Annotated[float, Field(ge=0, le=1e5)]
_Component = Annotated[float, Field(ge=-schema.MOST_COMPONENT, le=schema.MOST_COMPONENT)]
#: iOS sends -1 for unknown. The clients' own structures start with the largest float.
_Deviation = Annotated[float, Field(ge=-1, le=sys.float_info.max)]
_Latitude = Annotated[float, Field(ge=-90, le=90)]
_Longitude = Annotated[float, Field(ge=-180, le=180)]


class _Lenient(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class CameraParams(_Lenient):
    """Intrinsics of a camera, as in COLMAP, its depth range, and its height."""

    model: str | None = None
    modelParams: list[_Pixels] | None = Field(None, max_length=32)
    minMaxDepth: list[_Metres] | None = Field(None, max_length=2)
    heightAboveGround: float | None = Field(
        None,
        ge=LEAST_HEIGHT_M,
        le=MOST_HEIGHT_M,
        description="height of the colour camera above the ground, metres. A field of this service, not of the protocol. Not sent: "
        "the service finds the height in the DEPTH image",
    )
    heightAboveGroundAccuracy: float | None = Field(
        None,
        ge=LEAST_HEIGHT_STD_M,
        le=MOST_HEIGHT_STD_M,
        description="standard deviation of heightAboveGround, metres. A field of this service, not of the protocol",
    )


class ImageOrientation(_Lenient):
    """Orientation of the stored image."""

    mirrored: bool | None = None
    rotation: float | None = Field(None, ge=-360, le=360, description="rotation, degrees")


class CameraReading(_Lenient):
    """An image."""

    sensorId: str | None = None
    imageFormat: str | None = Field(
        None, description="RGBA32, JPG or GRAY8 for colour, whatever the format of the file. DEPTH for depth"
    )
    size: list[_Side] | None = Field(None, max_length=2, description="width, height")
    imageBytes: str | None = Field(None, description="base64 of an encoded image, with or without a data: prefix")
    imageOrientation: ImageOrientation | None = None
    params: CameraParams | None = None


class GeolocationReading(_Lenient):
    """Reading of a satellite receiver."""

    latitude: _Latitude | None = None
    longitude: _Longitude | None = None
    accuracy: _Deviation | None = None


class AccelerometerReading(_Lenient):
    """Reading of an accelerometer: specific force."""

    x: _Component | None = None
    y: _Component | None = None
    z: _Component | None = None


class SensorReadings(_Lenient):
    """Sensor readings of a client. The service ignores other kinds of readings."""

    cameraReadings: list[CameraReading] | None = Field(None, max_length=_MOST_READINGS)
    geolocationReadings: list[GeolocationReading] | None = Field(None, max_length=_MOST_READINGS)
    accelerometerReadings: list[AccelerometerReading] | None = Field(None, max_length=_MOST_READINGS)


class Accuracy(_Lenient):
    """Standard deviations. Position: mean of the components, metres. Orientation: mean of the three angles, degrees."""

    position: float | None = None
    orientation: float | None = None


class EarlierAccuracy(_Lenient):
    """Accuracy of an earlier answer, with the units of `Accuracy`."""

    position: _Deviation | None = None
    orientation: _Deviation | None = None


class EarlierPosition(_Lenient):
    """Position of an earlier answer, on the WGS-84 ellipsoid."""

    lat: _Latitude = Field(description="latitude, degrees")
    lon: _Longitude = Field(description="longitude, degrees")
    h: float = Field(ge=-1e5, le=1e5, description="height above the ellipsoid, metres")


class EarlierGeoPose(_Lenient):
    """Pose of an earlier answer."""

    position: EarlierPosition
    quaternion: schema.Quaternion


class PriorPose(_Lenient):
    """An earlier answer, as a prior pose."""

    accuracy: EarlierAccuracy | None = None
    geopose: EarlierGeoPose | None = None


class GeoPoseRequest(_Lenient):
    """Request of the OSCP GeoPose Protocol."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "4f0c8f4c0d5e4c0f9b4a3a1d4b7f9e21",
                    "timestamp": 1763452800000,
                    "type": "geopose",
                    "sensorReadings": {
                        "cameraReadings": [
                            {
                                "sensorId": "camera",
                                "imageFormat": "RGBA32",
                                "size": [640, 480],
                                "imageBytes": "/9j/4AAQSkZJRg==",
                                "params": {"model": "PINHOLE", "modelParams": [320, 320, 320, 240]},
                            },
                            {
                                "sensorId": "depth",
                                "imageFormat": "DEPTH",
                                "size": [640, 480],
                                "imageBytes": "iVBORw0KGgo=",
                            },
                        ],
                        "geolocationReadings": [{"latitude": 49.0, "longitude": 8.4, "accuracy": 10.0}],
                    },
                }
            ]
        }
    )

    id: str | None = Field(None, max_length=256)
    timestamp: float | None = Field(
        None, ge=0, le=1e19, description="Unix time, ms. Finer units pass, because the service does not read the field"
    )
    type: str | None = None
    sensorReadings: SensorReadings | None = None
    priorPoses: list[PriorPose] | None = Field(None, max_length=_MOST_READINGS)


class GeoPoseAnswer(BaseModel):
    """Answer of the OSCP GeoPose Protocol.

    The quaternion leads from east, north, up to the camera's axes: x right, y down, z forward.
    """

    id: str
    timestamp: int = Field(description="Unix time, ms")
    type: Literal["geopose"] = "geopose"
    accuracy: Accuracy
    geopose: schema.GeoPose


def query_of(request: GeoPoseRequest, map_name: str | None) -> EncodedQuery:
    """Build the query of the core.

    Args:
        request: of the protocol.
        map_name: map to use; None takes the only mounted map, or the nearest one to the prior of the request.

    Raises:
        RequestError: a reading is missing or invalid. A colour image without its DEPTH image is also an error.
        NotYetSupportedError: an image is mirrored or rotated, or the DEPTH image is of another camera.
    """
    readings = request.sensorReadings or SensorReadings()
    where = "sensorReadings.cameraReadings"
    colour = _reading(
        readings,
        _COLOUR,
        f"{where}: the colour image (imageFormat RGBA32) is missing; send it together with the DEPTH image",
    )
    depth = _reading(
        readings,
        ("DEPTH",),
        f"{where}: the depth image (imageFormat DEPTH) is missing, and this service needs colour and depth; send the image of the "
        "depth camera (16-bit PNG in mm, or float TIFF in m) as a second reading",
    )
    _require_same_view(colour, depth)
    content: dict[str, Any] = {
        "map": map_name,
        "camera": _camera(colour) | _height(colour),
        "depth": _depth_format(depth),
    }
    if gravity := _gravity(readings):
        content["gravity"] = gravity
    if prior := _prior(request, readings):
        content["prior"] = prior
    return query_from(
        checked(content, schema.LocalizeRequest),
        rgb=_bytes(colour, f"{where}.rgb.imageBytes"),
        depth=_bytes(depth, f"{where}.depth.imageBytes"),
    )


def accuracy_of(covariance: list[float] | None) -> Accuracy:
    """Return the means of the standard deviations; both are None if the covariance is unknown.

    Args:
        covariance: 6x6, row by row, translation (m), then rotation (rad).
    """
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
            "sensorReadings.cameraReadings.imageOrientation: only upright, unmirrored images are supported; "
            "rotate or mirror the image before you send it",
            field="sensorReadings.cameraReadings.imageOrientation",
        )
    return latest


def _camera(reading: CameraReading) -> dict[str, Any]:
    """Convert COLMAP's parameters to the camera of the contract."""
    where = "sensorReadings.cameraReadings.params"
    params = reading.params or CameraParams()
    model, numbers = (params.model or "").upper(), params.modelParams or []
    if model not in _MODELS or len(numbers) != _MODELS[model][0] + 2 + _MODELS[model][1]:
        raise RequestError(
            f"{where}: {len(numbers)} numbers do not fit the model {model or 'none'}; "
            f"send COLMAP's parameters of one of {', '.join(_MODELS)}",
            field=where,
        )
    if reading.size is None or len(reading.size) != 2:
        raise RequestError(
            "sensorReadings.cameraReadings.size: width or height is missing; send [width, height]",
            field="sensorReadings.cameraReadings.size",
        )
    focal, count, lens = _MODELS[model]
    fx, fy = numbers[0], numbers[focal - 1]
    cx, cy = numbers[focal : focal + 2]
    return {
        "width": int(reading.size[0]),
        "height": int(reading.size[1]),
        "fx": fx,
        "fy": fy,
        "cx": cx - 0.5,
        "cy": cy - 0.5,
        "distortion": numbers[focal + 2 :] + [0.0] * (max(count, _COEFFICIENTS) - count if count else 0),
        "distortion_model": lens,
    }


def _lens(camera: dict[str, Any]) -> tuple[str, tuple[float, ...]] | None:
    """Return model and coefficients of the lens; None for a pinhole."""
    model, distortion = camera["distortion_model"], tuple(camera["distortion"])
    return (model, distortion) if model == "kannala_brandt" or any(distortion) else None


def _height(reading: CameraReading) -> dict[str, float]:
    params = reading.params or CameraParams()
    if params.heightAboveGround is None:
        return {}
    std_m = params.heightAboveGroundAccuracy
    return {"height_m": params.heightAboveGround} | ({} if std_m is None else {"height_std_m": std_m})


def _require_same_view(colour: CameraReading, depth: CameraReading) -> None:
    """Refuse depth of another camera or another lens.

    The service reads depth with the colour camera's intrinsics, so depth must be aligned with it.
    """
    if depth.params is None or not depth.params.modelParams:
        return
    one, other = _camera(colour), _camera(depth)
    if _lens(one) != _lens(other):
        raise NotYetSupportedError(
            "sensorReadings.cameraReadings.depth.params: its distortion differs from that of the colour camera; send depth that is "
            "registered to the colour image, with the same distortion, or rectify both images",
            field="sensorReadings.cameraReadings.depth.params",
        )
    for focal, size in (("fx", "width"), ("fy", "height"), ("cx", "width"), ("cy", "height")):
        if abs(one[focal] / max(one[size], 1) - other[focal] / max(other[size], 1)) > _SAME_VIEW:
            raise NotYetSupportedError(
                f"sensorReadings.cameraReadings.depth.params: its {focal} differs from that of the colour camera; send depth that is "
                "registered to the colour image",
                field="sensorReadings.cameraReadings.depth.params",
            )


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
        raise DecodeError(f"{field}: not valid base64; encode the whole image file", field=field) from error


def _gravity(readings: SensorReadings) -> dict[str, float] | None:
    """Return the direction of gravity (down) in the camera frame."""
    for each in reversed(readings.accelerometerReadings or []):
        if each.x is not None and each.y is not None and each.z is not None and (each.x, each.y, each.z) != (0, 0, 0):
            return {"x": -each.x, "y": each.y, "z": each.z}
    return None


def _prior(request: GeoPoseRequest, readings: SensorReadings) -> dict[str, Any] | None:
    """Return the prior of the latest earlier pose, else of the satellite receiver."""
    for pose in reversed(request.priorPoses or []):
        if pose.geopose is not None:
            at, q = pose.geopose.position, pose.geopose.quaternion
            accuracy_m = None if pose.accuracy is None else pose.accuracy.position
            optical = (
                rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]))[:, 2]
                if any((q.x, q.y, q.z, q.w))
                else None
            )
            prior: dict[str, Any] = {"wgs84": _place(at.lat, at.lon, accuracy_m)}
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
