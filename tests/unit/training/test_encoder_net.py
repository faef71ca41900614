import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from torch import nn  # noqa: E402  # after the skip

from model_training.training.encoder_net import LAYERS, EncoderNet, EncoderShape, queries_first  # noqa: E402
from model_training.training.export import export  # noqa: E402
from service.errors import EncoderError  # noqa: E402
from service.retrieval.encoder import Encoder  # noqa: E402

# torch's tracing exporter is deprecated in favour of one that needs a newer runtime than the service has
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")


@pytest.fixture
def net(shape):
    torch.manual_seed(0)
    return EncoderNet(shape).eval()


def planes_of(shape, count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    planes = torch.rand(count, 6, shape.rows, shape.columns, generator=generator) * 30
    planes[:, 4] = 1.0
    return planes


@pytest.mark.parametrize("widths", [EncoderShape().widths, (4, 6, 6, 8)])
def test_the_encoder_has_twelve_layers_with_learned_weights(widths):
    layers = [m for m in EncoderNet(EncoderShape(widths=widths)).modules() if isinstance(m, nn.Conv2d | nn.Linear)]
    assert len(layers) == LAYERS == 12
    assert all(layer.weight.requires_grad for layer in layers)


def test_the_stock_shape_is_a_few_megabytes():
    count = sum(p.numel() for p in EncoderNet(EncoderShape()).parameters())
    assert 4 * count < 12e6


@pytest.mark.parametrize("side", [0.0, 1.0])
def test_descriptors_are_unit_vectors(net, shape, side):
    with torch.no_grad():
        found = net(planes_of(shape, 3), torch.full((3,), side))
    assert found.shape == (3, shape.descriptor)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(3))


def test_the_two_sides_read_one_view_differently(net, shape):
    with torch.no_grad():
        survey, query = (net(planes_of(shape, 1), torch.tensor([side])) for side in (0.0, 1.0))
    assert float((survey - query).abs().max()) > 1e-3


def test_queries_come_first(shape):
    planes = planes_of(shape, 5)
    assert queries_first(planes, 2).tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]
    assert queries_first(planes, 0).tolist() == [0.0] * 5


def test_a_view_does_not_depend_on_its_batch(net, shape):
    planes, side = planes_of(shape, 4), torch.tensor([0.0, 1.0, 1.0, 0.0])
    with torch.no_grad():
        together, alone = net(planes, side), torch.cat([net(planes[k : k + 1], side[k : k + 1]) for k in range(4)])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)


def test_a_view_without_any_measurement_has_a_descriptor(net, shape):
    with torch.no_grad():
        assert torch.isfinite(net(torch.zeros(1, 6, shape.rows, shape.columns), torch.zeros(1))).all()


@pytest.mark.parametrize("batch", [1, 2, 9])
@pytest.mark.parametrize("side", ["survey", "query"])
def test_onnx_says_what_torch_says_for_any_batch(net, shape, tmp_path, batch, side):
    export(net, tmp_path / "encoder.onnx")
    planes = planes_of(shape, batch, seed=7)
    with torch.no_grad():
        expected = net(planes, torch.full((batch,), 1.0 if side == "query" else 0.0)).numpy()
    found = Encoder.open(tmp_path / "encoder.onnx").encode(planes.numpy(), side)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_the_exported_encoder_is_one_file_that_knows_its_grid(net, shape, tmp_path):
    difference = export(net, tmp_path / "out" / "encoder.onnx")
    encoder = Encoder.open(tmp_path / "out" / "encoder.onnx")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["encoder.onnx"]
    assert (encoder.rows, encoder.columns, encoder.dimension) == (shape.rows, shape.columns, shape.descriptor)
    assert difference < 1e-4


def test_a_network_with_weights_that_are_no_numbers_is_not_written(net, tmp_path):
    with torch.no_grad():
        next(net.parameters()).fill_(np.nan)
    with pytest.raises(EncoderError, match=r"differ by nan.*nothing was written"):
        export(net, tmp_path / "encoder.onnx")
    assert list(tmp_path.iterdir()) == []


def test_an_export_that_differs_is_refused_and_nothing_is_written(net, tmp_path, monkeypatch):
    monkeypatch.setattr("model_training.training.export.TOLERANCE", -1.0)
    with pytest.raises(EncoderError, match="nothing was written"):
        export(net, tmp_path / "encoder.onnx")
    assert list(tmp_path.iterdir()) == []
