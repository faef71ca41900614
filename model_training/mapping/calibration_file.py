"""The calibration that comes with the stock encoder, or another one."""

from pathlib import Path

from service.errors import DatasetError
from service.maps.calibration import Calibration, read_calibration


def calibration_for(path: Path | None, encoder_sha256: str) -> Calibration | None:
    """The calibration of an encoder's answers, if the file has it; another encoder's similarities mean something else.

    Args:
        path: of the file; None asks for none.
        encoder_sha256: of the encoder that will answer.

    Raises:
        DatasetError: the file is missing.
        BundleError: it is no calibration.
    """
    if path is None:
        return None
    try:
        document = path.read_bytes()
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be read ({error.strerror}); make it with streetfix calibrate", field="calibration"
        ) from error
    calibration = read_calibration(document, path=str(path))
    fits = calibration is not None and calibration.measured_on.get("encoder_sha256") == encoder_sha256
    return calibration if fits else None
