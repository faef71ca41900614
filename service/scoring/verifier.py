"""The verifier: a small network that says from a comparison of image and map whether a pose is right.

Hand-made numbers of a pose (inliers, edges, steps behind surfaces) count what agrees. The network sees where it agrees: whether a
difference has the shape of a vehicle, a tree or a house, and whether windows and markings coincide. It is trained in cities, with rigs and
surveys, that no calibration and no evaluation uses (``streetfix train-verifier``). Its output is one feature of the confidence, which
calibrates it, and a part of the support of a pose.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.errors import EncoderError
from service.onnx_session import Session, session_of
from service.scoring.comparison import COLUMNS, PLANES, ROWS, Comparison

#: The verifier that belongs to this version of the program.
SHIPPED = Path(__file__).with_name("verifier.onnx")
#: What to do about a bad verifier of one's own, and about a bad one of this version of the program.
_TRAIN, _INSTALL = "train it with `streetfix train-verifier`", "install Streetfix again"


@runtime_checkable
class PoseVerifier(Protocol):
    """What the localizer needs of a verifier. The training uses one without a network."""

    def log_odds(self, comparisons: Sequence[Comparison]) -> Float32[NDArray[np.float32], " n"]:
        """Return for each comparison the log odds that its pose is within 1 m.

        Args:
            comparisons: comparisons of poses; may be empty.
        """
        ...


class Verifier:
    """A network under ONNX Runtime; safe to use from several threads. Build it with ``open`` or ``shipped``.

    Args:
        session: session of ONNX Runtime with the network.
        remedy: what to do if the network cannot be used.

    Raises:
        EncoderError: the network does not read single comparisons of this program, or does not return one number for each.
    """

    def __init__(self, session: Session, *, remedy: str = _TRAIN) -> None:
        self._session = session
        inputs = {each.name: list(each.shape) for each in session.get_inputs()}
        outputs = {each.name: list(each.shape) for each in session.get_outputs()}
        batch, *planes = inputs.get("comparison", [None])
        fixed = isinstance(batch, int) and batch != 1  # a batch of any size has a name instead of a number
        one_number = len(outputs.get("log_odds", [])) == 1
        if len(inputs) != 1 or planes != [len(PLANES), ROWS, COLUMNS] or fixed or not one_number:
            raise EncoderError(
                f"the verifier reads {inputs} and returns {outputs}, but comparison -> log_odds are expected, {len(PLANES)} planes of "
                f"{ROWS} x {COLUMNS} in a batch of 1 or of any size; {remedy}",
                field="verifier",
            )

    @staticmethod
    def open(source: Path | bytes, *, remedy: str = _TRAIN) -> "Verifier":
        """Open a verifier from an ONNX file or from its bytes.

        Args:
            source: path of the file, or its content.
            remedy: what to do if the file cannot be used.

        Raises:
            EncoderError: the file cannot be read, or is no verifier.
        """
        named = "the content" if isinstance(source, bytes) else str(source)
        try:
            session = session_of(source if isinstance(source, bytes) else source.read_bytes())
        except OSError as error:  # the text of the error names the file
            raise EncoderError(f"the verifier cannot be read ({error}); {remedy}", field="verifier") from error
        except Exception as error:  # the exceptions of ONNX Runtime have no common base class
            raise EncoderError(
                f"{named}: ONNX Runtime cannot load the verifier ({error}); {remedy}", field="verifier"
            ) from error
        return Verifier(session, remedy=remedy)

    @staticmethod
    @cache
    def shipped() -> "Verifier":
        """Return the verifier of this version of the program.

        Raises:
            EncoderError: the file is missing or damaged.
        """
        return Verifier.open(SHIPPED, remedy=_INSTALL)

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
