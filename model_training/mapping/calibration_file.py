"""Read the calibration file for an encoder, and renew the calibration of a map."""

import json
from pathlib import Path

from pydantic import ValidationError

from service.confidence.features import require_features
from service.errors import BundleError, DatasetError
from service.maps.calibration import Calibration, Site, read_calibration
from service.maps.content import CALIBRATION_FILE
from service.maps.manifest import Manifest, read_manifest
from service.maps.writer import replace_calibration


def calibration_for(path: Path | None, encoder_sha256: str) -> Calibration | None:
    """Return the calibration for an encoder; None if the file is not for this encoder.

    A calibration holds for one encoder only, because each encoder has its own scale of similarities.

    Args:
        path: the calibration file; None returns None.
        encoder_sha256: SHA-256 of the encoder that will answer, hexadecimal.

    Raises:
        DatasetError: the file cannot be read.
        BundleError: the file is not a calibration, or one of other confidence features.
    """
    if path is None:
        return None
    try:
        document = path.read_bytes()
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be read ({error.strerror}); create it with streetfix calibrate", field="calibration"
        ) from error
    calibration = read_calibration(document, path=str(path))
    require_features(calibration, str(path))
    fits = calibration is not None and calibration.measured_on.get("encoder_sha256") == encoder_sha256
    return calibration if fits else None


def renew_calibration(folder: Path, path: Path) -> tuple[Manifest, bool]:
    """Replace the calibration of a map by that of a file, atomically. The map keeps its site check.

    The old calibration may be of another release: only its site check is read. Corrections for rigs are removed, because they were
    learned on the old confidence.

    Args:
        folder: the map bundle or tiled map.
        path: the calibration file.

    Returns:
        The new manifest, and whether corrections for rigs were removed.

    Raises:
        DatasetError: the file cannot be read.
        BundleError: the folder is no map, the file is no calibration of this release, or it is for another encoder than that of the map.
    """
    manifest = read_manifest(folder)
    calibration = calibration_for(path, manifest.encoder_sha256)
    if calibration is None:
        raise BundleError(
            f"{folder}: {path} is not the calibration of the encoder of this map; give the file that `streetfix calibrate --encoder` wrote "
            "for this encoder", field="calibration",
        )  # fmt: skip
    site, had_rig = _site_of(folder / CALIBRATION_FILE)
    renewed = calibration.model_copy(update={"site": site, "rig": None, "rigs": ()})
    return replace_calibration(folder, renewed.model_dump(mode="json")), had_rig


def _site_of(path: Path) -> tuple[Site | None, bool]:
    """Return the site check of a stored calibration, None if there is none, and whether it has corrections for rigs."""
    try:
        content = json.loads(path.read_bytes())
        site = content.get("site")
        had_rig = content.get("rig") is not None or bool(content.get("rigs"))
        return None if site is None else Site.model_validate(site), had_rig
    except OSError as error:
        raise BundleError(
            f"{path} cannot be read ({error.strerror}); build the map again", field=CALIBRATION_FILE
        ) from error
    except (ValueError, AttributeError, RecursionError, ValidationError) as error:
        raise BundleError(
            f"{path}: its site check cannot be read; build the map again", field=CALIBRATION_FILE
        ) from error
