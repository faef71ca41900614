from itertools import islice

import numpy as np
import onnx
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.cli import quantize as cli  # noqa: E402  # after the skip
from model_training.training import quantise as module  # noqa: E402
from model_training.training.encoder_net import EncoderNet  # noqa: E402
from model_training.training.export import export  # noqa: E402
from model_training.training.loop import TrainingConfig  # noqa: E402
from model_training.training.quantise import Views, quantise  # noqa: E402
from model_training.training.sampling import augmented_batches  # noqa: E402
from service.errors import EncoderError  # noqa: E402
from service.retrieval.encoder import Encoder  # noqa: E402

# torch's tracing exporter is deprecated in favour of one that needs a newer runtime than the service has
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")


@pytest.fixture
def encoder(shape, tmp_path):
    torch.manual_seed(0)
    export(EncoderNet(shape), tmp_path / "encoder.onnx", trained_on=("city-1000", "city-1001"))
    return tmp_path / "encoder.onnx"


@pytest.fixture
def views(shape, pack_folder):
    batches = augmented_batches([pack_folder], TrainingConfig(pairs=16, encoder=shape), seed=0)
    return [Views(np.ascontiguousarray(planes.numpy()), queries) for planes, queries in islice(batches, 4)]


def test_descriptors_hardly_move_and_the_file_shrinks(encoder, views, tmp_path):
    out = tmp_path / "eight" / "encoder.onnx"
    agreement = quantise(encoder, out, views[:2], views[2:])
    assert agreement.views == sum(len(each.planes) for each in views[2:])
    assert 0.999 <= agreement.mean < 1.0
    assert agreement.of_hundred <= agreement.mean
    before, after = Encoder.open(encoder), Encoder.open(out)
    cosine = (views[3].encoded(before) * views[3].encoded(after)).sum(axis=1)
    assert cosine.min() > 0.99
    assert (after.rows, after.columns, after.dimension) == (before.rows, before.columns, before.dimension)
    assert after.trained_on == ("city-1000", "city-1001")
    weights = [each for each in onnx.load(out).graph.initializer if each.data_type == onnx.TensorProto.INT8]
    assert len(weights) >= 12  # of every layer
    assert max(int(np.abs(onnx.numpy_helper.to_array(each).astype(int)).max()) for each in weights) <= 64


def test_both_sides_are_read_by_their_own_filters(encoder, views, tmp_path):
    quantise(encoder, tmp_path / "eight.onnx", views[:2], views[2:])
    after = Encoder.open(tmp_path / "eight.onnx")
    assert np.abs(after.encode(views[0].planes, "query") - after.encode(views[0].planes, "survey")).max() > 1e-3


@pytest.mark.parametrize("bound", ["LEAST_MEAN", "LEAST_OF_HUNDRED"])
def test_descriptors_that_differ_too_much_are_found_out_and_nothing_is_written(
    bound, encoder, views, tmp_path, monkeypatch
):
    monkeypatch.setattr(module, bound, 1.0 - 1e-9)
    with pytest.raises(EncoderError, match="nothing was written"):
        quantise(encoder, tmp_path / "eight.onnx", views[:2], views[2:])
    assert list(tmp_path.glob("eight*")) == []


def test_an_encoder_in_eight_bits_is_not_quantised_again(encoder, views, tmp_path):
    quantise(encoder, tmp_path / "eight.onnx", views[:2], views[2:])
    with pytest.raises(EncoderError, match="already has 8 bits"):
        quantise(tmp_path / "eight.onnx", tmp_path / "again.onnx", views[:2], views[2:])


def test_the_command_writes_a_file_and_says_how_near_it_is(encoder, pack_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cli, "make_packs", lambda plans, *_, **__: [pack_folder] * len(plans))
    cli.command(encoder, tmp_path / "eight.onnx", packs=tmp_path, cities=1, pairs=8, seed=3)
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "cosine to the float32 descriptors: mean 0.99" in said or "cosine to the float32 descriptors: mean 1.00" in said
    )
    assert Encoder.open(tmp_path / "eight.onnx").sha256 != Encoder.open(encoder).sha256


def test_the_command_refuses_what_is_no_encoder_before_cities_are_simulated(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "make_packs", lambda *_, **__: pytest.fail("simulated"))
    (tmp_path / "text.onnx").write_text("none")
    with pytest.raises(EncoderError, match="ONNX Runtime cannot load the encoder"):
        cli.command(tmp_path / "text.onnx", tmp_path / "eight.onnx")
