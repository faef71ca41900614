"""Read the calibration file for an encoder."""

from pathlib import Path

from service.confidence.features import require_features
from service.errors import DatasetError
from service.maps.calibration import Calibration, read_calibration


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
