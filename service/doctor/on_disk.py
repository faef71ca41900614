"""Checks of a map bundle: files, encoder, calibration, cloud and streets."""

from pathlib import Path

from service.doctor.finding import Finding
from service.errors import StreetfixError
from service.localization.localizer import Localizer
from service.maps.map import Map
from service.maps.tiles import open_map


def check_bundle(path: Path) -> tuple[Finding, Map | None]:
    """Check that a bundle opens and that its files have the hashes of its manifest.

    Args:
        path: folder of the bundle.

    Returns:
        The finding, and the bundle if it opens.
    """
    try:
        bundle = open_map(path)
    except StreetfixError as error:
        return Finding.of_error("map", error), None
    manifest = bundle.manifest
    text = (
        f"{manifest.name}, version {manifest.version}: the hashes of its {len(manifest.files)} files match; "
        f"{manifest.counts.places} places"
    )
    return Finding("map", "ok", text), bundle


def check_encoder(bundle: Map) -> tuple[Finding, Localizer | None]:
    """Check that the encoder of a map runs, and that it belongs to the map's descriptors.

    A verifier that cannot be used is a finding of its own: it belongs to the program, not to the map.

    Args:
        bundle: the map.

    Returns:
        The finding, and the localizer of the map if it can be made.
    """
    try:
        localizer = Localizer.open(bundle)
    except StreetfixError as error:
        return Finding.of_error("verifier" if error.field == "verifier" else "encoder", error), None
    encoder = localizer.encoder
    text = f"reads views of {encoder.rows} x {encoder.columns} cells and returns descriptors of {encoder.dimension} numbers"
    return Finding("encoder", "ok", text), localizer


def check_calibration(bundle: Map, false_accept_rate: float) -> Finding:
    """Check that the map is calibrated, and that its calibration can promise the false-accept rate of the service.

    Args:
        bundle: the map.
        false_accept_rate: setting of the service.
    """
    calibration = bundle.calibration
    if calibration is None:
        return Finding(
            "calibration",
            "warning",
            "the map is not calibrated: answers have no confidence, and all of them are LOCALIZED",
            "build the map with an encoder that has a calibration, or fit one (streetfix calibrate)",
        )
    least = calibration.least_false_accept_rate
    if false_accept_rate < least:
        return Finding(
            "calibration",
            "problem",
            f"the setting false_accept_rate is {false_accept_rate:g}, but the calibration of the map supports {least:g} or more",
            f"set STREETFIX_FALSE_ACCEPT_RATE to {least:g} or more",
        )
    site = "not corrected for this site" if calibration.site is None else "corrected for this site"
    rig = "" if calibration.rig is None else f", and for every rig ({calibration.rig.measured_on})"
    rigs = "".join(f", and for {each.name} ({each.measured_on})" for each in calibration.rigs)
    return Finding("calibration", "ok", f"the map is calibrated, {site}{rig}{rigs}")


def check_cloud(bundle: Map) -> Finding:
    """Check that the map has a cloud to register images on.

    Args:
        bundle: the map.
    """
    if bundle.cloud is None:
        return Finding(
            "cloud",
            "warning",
            "the map has no cloud: an answer is the pose of a place, without registration and confidence",
            "build the map again with its cloud",
        )
    return Finding("cloud", "ok", f"{bundle.manifest.counts.cloud_points} surfels")


def check_streets(bundle: Map) -> Finding:
    """Check that the map knows its streets.

    Args:
        bundle: the map.
    """
    if bundle.streets is None:
        return Finding(
            "streets",
            "warning",
            "the map has no streets: answers have no street",
            "create streets.geojson (streetfix streets) in the dataset and build the map again",
        )
    return Finding("streets", "ok", f"{len(bundle.streets)} streets or sections")
