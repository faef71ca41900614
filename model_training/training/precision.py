"""Half precision where the processor multiplies it natively."""

from contextlib import AbstractContextManager
from typing import Literal

import torch

Precision = Literal["float32", "bfloat16"]


def native_precision() -> Precision:
    """``bfloat16`` on processors with instructions for it (AVX-512 BF16); elsewhere torch emulates it, slower than float32."""
    supported: bool = torch.cpu._is_avx512_bf16_supported()  # torch has no public question for it
    return "bfloat16" if supported else "float32"


def forward_in(precision: Precision, device_type: str = "cpu") -> AbstractContextManager[None]:
    """Convolutions and matrix products of a forward pass in ``precision``; weights, norms and what follows stay float32.

    Wrap the network alone: torch's autocast casts back for the gradients, and a loss wants float32.
    """
    return torch.autocast(device_type, torch.bfloat16, enabled=precision == "bfloat16")
