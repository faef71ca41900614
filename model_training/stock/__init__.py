"""The encoder that comes with the package; MODEL_CARD.md beside it says what it was trained on and how well it does."""

from pathlib import Path

ENCODER = Path(__file__).with_name("encoder.onnx")
CALIBRATION = Path(__file__).with_name("calibration.json")
