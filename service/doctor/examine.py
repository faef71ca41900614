"""Run all checks that the arguments allow, in the order in which one would look for a fault."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

from service.contract.schema import LocalizeRequest
from service.doctor import camera_file, machine, on_disk, on_map
from service.doctor.finding import Finding
from service.doctor.ground import check_ground, ground_of
from service.doctor.pair import Pair, check_depth_unit, check_images, check_measured_share, encoded_of
from service.doctor.registered import check_registered
from service.errors import StreetfixError
from service.localization.localizer import Localizer
from service.option_limits import FALSE_ACCEPT_RATE
from service.runtime.settings import Settings, load_settings


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorInputs:
    """Files and ports to check.

    Attributes:
        bundle: folder of a map bundle.
        camera: file with the JSON part of a request.
        rgb: file of the colour image. It needs ``depth`` and ``camera``.
        depth: file of the depth image.
        port: HTTP port of the service; None takes that of the settings.
        grpc_port: gRPC port of the service; None takes that of the settings.
    """

    bundle: Path | None = None
    camera: Path | None = None
    rgb: Path | None = None
    depth: Path | None = None
    port: int | None = None
    grpc_port: int | None = None


def examine(given: DoctorInputs) -> Iterator[Finding]:
    """Yield the finding of each check as soon as it is known.

    Args:
        given: files and ports to check.
    """
    finding, settings = check_settings(given)
    yield from _machine(given, finding, settings)
    rate = FALSE_ACCEPT_RATE if settings is None else settings.false_accept_rate
    localizer = None
    if given.bundle is not None:
        localizer = yield from _map(given.bundle, rate)
    if given.camera is None:
        return
    finding, request = camera_file.check_camera_file(given.camera)
    yield finding
    if request is None:
        return
    yield camera_file.check_principal_point(request.camera)
    yield camera_file.check_field_of_view(request.camera)
    yield camera_file.check_focal_lengths(request.camera)
    yield camera_file.check_distortion(request.camera)
    if given.rgb is None or given.depth is None:
        return
    pair = yield from _pair(request, given.rgb, given.depth)
    if pair is not None and localizer is not None:
        bundle = localizer.bundle
        yield on_map.check_rows(on_map.rows_of_camera(pair, bundle), bundle.rows_seen, bundle.grid.elevations_rad)
        yield on_map.check_answer(pair, localizer, rate)


def check_settings(given: DoctorInputs) -> tuple[Finding, Settings | None]:
    """Check the settings of a service: the variables ``STREETFIX_*`` and the settings file.

    Args:
        given: what to check; its ports override the settings.

    Returns:
        The finding, and the settings if they are valid.
    """
    try:
        settings = load_settings(port=given.port, grpc_port=given.grpc_port)
    except StreetfixError as error:
        return Finding.of_error("settings", error), None
    return Finding(
        "settings", "ok", f"the variables STREETFIX_* are valid: a service listens on {settings.host}"
    ), settings


def _machine(given: DoctorInputs, finding: Finding, settings: Settings | None) -> Iterator[Finding]:
    yield machine.check_platform()
    yield machine.check_cores(settings)
    yield machine.check_instructions()
    yield machine.check_shared_memory()
    yield machine.check_libraries(machine.LIBRARIES)
    yield finding
    if settings is not None:
        yield machine.check_port("--port", settings.host, settings.port, named=given.port is not None)
        yield machine.check_port("--grpc-port", settings.host, settings.grpc_port, named=given.grpc_port is not None)


def _map(path: Path, false_accept_rate: float) -> Generator[Finding, None, Localizer | None]:
    finding, bundle = on_disk.check_bundle(path)
    yield finding
    if bundle is None:
        return None
    finding, localizer = on_disk.check_encoder(bundle)
    yield finding
    yield on_disk.check_calibration(bundle, false_accept_rate)
    yield on_disk.check_cloud(bundle)
    yield on_disk.check_streets(bundle)
    return localizer


def _pair(request: LocalizeRequest, rgb: Path, depth: Path) -> Generator[Finding, None, Pair | None]:
    try:
        encoded = encoded_of(request, rgb.read_bytes(), depth.read_bytes())
    except OSError as error:
        yield Finding(
            "images", "problem", f"{error.filename}: cannot be read ({error.strerror})", "check --rgb and --depth"
        )
        return None
    except StreetfixError as error:
        yield Finding.of_error("camera file", error)
        return None
    finding, pair = check_images(encoded)
    yield finding
    if pair is None:
        return None
    finding, pair = check_depth_unit(pair)
    yield finding
    yield check_measured_share(pair)
    if not pair.depth_m.any():
        return None
    yield check_registered(pair.rgb, pair.depth_m)
    encoded, flat = pair.encoded, pair.rectified()
    yield check_ground(ground_of(flat.depth_m, flat.camera, encoded.down_camera, encoded.camera_height))
    return pair
