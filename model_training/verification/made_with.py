"""What the examples of a city depend on, besides its plan: stored beside them, so that a training does not mix them with others."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.calibration.answer_code import ANSWERING, ENDINGS, code_of
from model_training.datasets.files import read_arrays
from service.retrieval.encoder import Encoder
from service.scoring.comparison import PLANES

#: Folders and files that the examples depend on, relative to the repository or the installation.
CODE = (
    *ANSWERING,
    "model_training/calibration/families.py",
    "model_training/evaluation/odometry.py",
    *(f"model_training/training/{name}.py" for name in ("random_rigs", "recipe")),
    *(f"model_training/verification/{name}.py" for name in ("even_odds", "examples", "plans")),
)
#: Networks do not count. The examples depend on no verifier, and a training replaces the one in ``service/scoring``.
_ENDINGS = tuple(ending for ending in ENDINGS if ending != ".onnx")
_ENCODER, _CODE, _PLANES = "encoder_sha256", "code", "plane_names"
#: Advice for a damaged file of examples.
REMEDY = "remove it, and the command makes it again"


@dataclass(frozen=True, slots=True)
class MadeWith:
    """What examples depend on.

    Attributes:
        encoder_sha256: hash of the encoder of the maps.
        code: hash of the code, as ``code_of`` returns it.
        planes: names of the planes of a comparison, in their order.
    """

    encoder_sha256: str
    code: str
    planes: tuple[str, ...]

    @classmethod
    def of(cls, encoder: Path) -> "MadeWith":
        """Describe examples that the present code makes.

        Args:
            encoder: the encoder, ONNX.

        Raises:
            EncoderError: the encoder cannot be used.
        """
        return cls(Encoder.open(encoder).sha256, code_of(CODE, endings=_ENDINGS), PLANES)

    @classmethod
    def read(cls, path: Path) -> "MadeWith | None":
        """Read what the examples of a file were made with; None for a file that does not say it.

        Args:
            path: NPZ file of ``Examples.write``.

        Raises:
            DatasetError: the file is missing or damaged.
        """

        def content() -> MadeWith | None:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                if not {_ENCODER, _CODE, _PLANES} <= set(arrays.files):
                    return None
                return cls(str(arrays[_ENCODER]), str(arrays[_CODE]), tuple(arrays[_PLANES].tolist()))

        return read_arrays(path, content, remedy=REMEDY)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that ``read`` reads."""
        return {
            _ENCODER: np.array(self.encoder_sha256),
            _CODE: np.array(self.code),
            _PLANES: np.array(self.planes),
        }

    @property
    def key(self) -> str:
        """A short name: twelve digits of the encoder's hash and sixteen of that of the code."""
        return f"{self.encoder_sha256[:12]}-{self.code}"

    def difference_to(self, other: "MadeWith | None") -> str:
        """Say in which respects other examples differ.

        Args:
            other: what the other examples were made with; None if that is not known.
        """
        if other is None:
            return "an unknown version of the code"
        differing = {
            "another encoder": self.encoder_sha256 != other.encoder_sha256,
            "another version of the code": self.code != other.code,
            "other planes": self.planes != other.planes,
        }
        return " and ".join(what for what, differs in differing.items() if differs)
