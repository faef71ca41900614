"""Checks of an image pair on a map: the rows that both sensors see, and the answer."""

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from service.doctor.finding import Finding
from service.doctor.pair import Pair
from service.errors import StreetfixError
from service.imaging.level import level_query
from service.imaging.resample import resample
from service.localization.answer import Answer
from service.localization.localizer import Localizer
from service.maps.map import Map
from service.runtime.engine import query_in

#: Share of the camera's rows that the LiDAR must see.
LEAST_OVERLAP = 0.5
#: What helps if the evidence of an answer lies outside the range of the calibration data.
OWN_RECORDING = "calibrate the map on a recording of this rig (streetfix calibrate --map --drive)"


def rows_of_camera(pair: Pair, bundle: Map) -> Bool[NDArray[np.bool_], " rows"]:
    """Return the rows of the view grid that the camera sees in at least half of the columns that the camera sees at all.

    Args:
        pair: decoded images.
        bundle: the map.
    """
    encoded, flat = pair.encoded, pair.rectified()
    level, _ = level_query(flat.depth_m, flat.camera, down_camera=encoded.down_camera, given=encoded.camera_height)
    _, _, seen = resample(flat.rgb, flat.depth_m, flat.camera, level.R_level_camera.T, bundle.grid, flat.observed)
    columns = int(seen.any(axis=0).sum())
    rows: Bool[NDArray[np.bool_], " rows"] = (seen.sum(axis=1) * 2 >= columns) & (columns > 0)
    return rows


def check_rows(
    camera_rows: Bool[NDArray[np.bool_], " rows"],
    lidar_rows: Bool[NDArray[np.bool_], " rows"],
    elevations_rad: NDArray[np.float64],
) -> Finding:
    """Check that the LiDAR of the survey saw the heights that the camera sees.

    Args:
        camera_rows: rows of the view grid that the camera sees.
        lidar_rows: rows that the LiDAR saw.
        elevations_rad: elevation of each row, radians.
    """
    check = "same heights"
    if not camera_rows.any():
        return Finding(
            check,
            "warning",
            "the camera covers no row of the view grid of the map",
            "level the camera, and check its intrinsics",
        )
    overlap = float(np.mean(lidar_rows[camera_rows]))
    text = (
        f"the LiDAR of the survey covers {overlap:.0%} of the rows that the camera covers (camera {_span(camera_rows, elevations_rad)}, "
        f"LiDAR {_span(lidar_rows, elevations_rad)})"
    )
    if overlap >= LEAST_OVERLAP:
        return Finding(check, "ok", text)
    return Finding(
        check,
        "warning",
        text,
        "level the camera so that both cover the same heights, or survey with a LiDAR that covers them",
    )


def _span(rows: Bool[NDArray[np.bool_], " rows"], elevations_rad: NDArray[np.float64]) -> str:
    if not rows.any():
        return "none"
    inside = np.rad2deg(elevations_rad[rows])
    return f"{inside.min():.0f} to {inside.max():.0f} degrees"


def answer_of(pair: Pair, localizer: Localizer, false_accept_rate: float) -> Answer:
    """Localize the pair as a service does.

    Args:
        pair: decoded images; their encoded form is decoded again, as a service decodes it.
        localizer: of the map.
        false_accept_rate: setting of the service.

    Raises:
        StreetfixError: the service would refuse the query.
    """
    return localizer.localize(query_in(pair.encoded, localizer.bundle, false_accept_rate))


def check_answer(pair: Pair, localizer: Localizer, false_accept_rate: float) -> Finding:
    """Localize the pair, and report status, confidence and reasons.

    Args:
        pair: decoded images.
        localizer: of the map.
        false_accept_rate: setting of the service.
    """
    try:
        answer = answer_of(pair, localizer, false_accept_rate)
    except StreetfixError as error:
        return Finding.of_error("answer", error)
    confidence = "no confidence" if answer.confidence is None else f"confidence {answer.confidence:.3f}"
    rig = "" if answer.rig_correction is None else f", with the correction for {answer.rig_correction}"
    text = f"{answer.status} ({confidence}{rig})"
    if answer.extrapolated:
        outside = ", ".join(f"{name} {size:+.1f}" for name, size in answer.extrapolated)
        text += f", extrapolated: {outside} standard deviations from the mean of the calibration data"
    if answer.status == "LOCALIZED":
        if answer.extrapolated:
            return Finding("answer", "warning", text, f"the confidence may be wrong; {OWN_RECORDING}")
        return Finding("answer", "ok", text)
    reasons = "; ".join(f"{each.check}: {each.remedy}" for each in answer.reasons)
    if answer.extrapolated:
        return Finding("answer", "warning", text, f"{reasons}; or {OWN_RECORDING}" if reasons else OWN_RECORDING)
    in_range = "all confidence features are in the range of the calibration data"
    return Finding(
        "answer",
        "warning",
        text,
        reasons or f"{in_range}; the place may be outside the map, or look like another place",
    )
