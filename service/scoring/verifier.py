"""The verifier: a small network that says from a comparison of image and map whether a pose is right.

Hand-made numbers of a pose (inliers, edges, steps behind surfaces) count what agrees. The network sees where it agrees: whether a
difference has the shape of a vehicle, a tree or a house, and whether windows and markings coincide. It is trained in cities, with rigs and
surveys, that no calibration and no evaluation uses (``streetfix train-verifier``). Its output is one feature of the confidence, which
calibrates it, and a part of the support of a pose.
"""

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.errors import EncoderError
from service.onnx_session import Session, session_of
from service.scoring.comparison import COLUMNS, PLANES, ROWS, Comparison

#: The verifier that belongs to this version of the program.
SHIPPED = Path(__file__).with_name("verifier.onnx")


class Verifier:
    """A network under ONNX Runtime; safe to use from several threads. Build it with ``open`` or ``shipped``.

    Args:
        session: session of ONNX Runtime with the network.
        sha256: hash of the ONNX file.

    Attributes:
        sha256: hash of the ONNX file.

    Raises:
        EncoderError: the network does not read comparisons of this program.
    """

    def __init__(self, session: Session, sha256: str) -> None:
        self._session, self.sha256 = session, sha256
        shapes = {each.name: list(each.shape)[1:] for each in session.get_inputs()}
        if shapes != {"comparison": [len(PLANES), ROWS, COLUMNS]}:
            raise EncoderError(
                f"the verifier reads {shapes}, but comparisons have {len(PLANES)} planes of {ROWS} x {COLUMNS}; train it with "
                "`streetfix train-verifier`",
                field="verifier",
            )

    @staticmethod
    def open(source: Path) -> "Verifier":
        """Open a verifier.

        Args:
            source: path of the ONNX file.

        Raises:
            EncoderError: the file cannot be read, or is no verifier.
        """
        try:
            data = source.read_bytes()
        except OSError as error:  # the text of the error names the file
            raise EncoderError(f"the verifier cannot be read ({error}); check the path", field="verifier") from error
        try:
            session = session_of(data)
        except Exception as error:  # the exceptions of ONNX Runtime have no common base class
            raise EncoderError(
                f"{source}: ONNX Runtime cannot load the verifier ({error}); train it with `streetfix train-verifier`",
                field="verifier",
            ) from error
        return Verifier(session, hashlib.sha256(data).hexdigest())

    @staticmethod
    @cache
    def shipped() -> "Verifier":
        """Return the verifier of this version of the program.

        Raises:
            EncoderError: the file is missing or damaged.
        """
        return Verifier.open(SHIPPED)

    def log_odds(self, comparisons: Sequence[Comparison]) -> Float32[NDArray[np.float32], " n"]:
        """Return for each comparison the log odds that its pose is within 1 m.

        Each comparison is a run of its own. ONNX Runtime keeps the memory of its largest run, and larger runs save hardly any time. Their
        log odds would be the same, to the bit.

        Args:
            comparisons: comparisons of poses; may be empty.
        """
        found = np.empty(len(comparisons), np.float32)
        for number, comparison in enumerate(comparisons):
            (found[number : number + 1],) = self._session.run(["log_odds"], {"comparison": comparison[np.newaxis]})
        return found
