"""Half precision on processors that multiply it natively."""

from contextlib import AbstractContextManager
from typing import Literal

import torch

Precision = Literal["float32", "bfloat16"]


def native_precision() -> Precision:
    """Return ``bfloat16`` if the processor has AVX-512 BF16 instructions, otherwise ``float32``.

    Without these instructions torch emulates bfloat16, slower than float32.
    """
    supported: bool = torch.cpu._is_avx512_bf16_supported()  # torch has no public function for this
    return "bfloat16" if supported else "float32"


def forward_in(precision: Precision, device_type: str = "cpu") -> AbstractContextManager[None]:
    """Return a context that runs convolutions and matrix products of a forward pass in a precision.

    Weights and normalisation stay float32. Wrap only the network: autocast casts back for the gradients, and a loss needs
    float32.

    Args:
        precision: of the forward pass.
        device_type: ``cpu`` or ``cuda``.
    """
    return torch.autocast(device_type, torch.bfloat16, enabled=precision == "bfloat16")
