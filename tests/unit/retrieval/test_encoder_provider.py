import onnxruntime
import pytest

from service.errors import EncoderError
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder


def test_a_provider_that_is_not_installed_is_refused_with_what_there_is(encoder_of, monkeypatch):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(EncoderError, match=r"lacks 'cuda' \(available: cpu\); install onnxruntime-gpu"):
        Encoder.open(encoder_of(), provider="cuda")
    with pytest.raises(EncoderError, match="install onnxruntime-openvino"):
        Encoder.open(encoder_of(), provider="openvino")


def test_the_session_runs_on_the_provider_that_was_chosen(encoder_of, bundle_path, monkeypatch):
    asked = []
    real = onnxruntime.InferenceSession

    def session(data, options, *, providers):
        asked.append(providers)
        return real(data, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    monkeypatch.setattr(
        onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"]
    )
    Encoder.open(encoder_of(), provider="cuda")
    Localizer.open(MapBundle.open(bundle_path), provider="cuda")
    Localizer.open(MapBundle.open(bundle_path))
    assert asked == [["CUDAExecutionProvider"], ["CUDAExecutionProvider"], ["CPUExecutionProvider"]]
