from itertools import islice

import numpy as np
import onnx
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.encoder_net import EncoderNet, EncoderShape  # noqa: E402
from model_training.training.export import export  # noqa: E402
from model_training.training.from_onnx import net_of  # noqa: E402
from model_training.training.loop import TrainingConfig, load_run, read_packs, train  # noqa: E402
from model_training.training.quantise import Views, quantise  # noqa: E402
from model_training.training.sampling import augmented_batches  # noqa: E402  # after the skip
from service.errors import DatasetError, EncoderError  # noqa: E402
from service.retrieval.encoder import Encoder  # noqa: E402

# torch's tracing exporter is deprecated in favour of one that needs a newer runtime than the service has
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")


@pytest.fixture
def views(shape, pack_folder):
    batches = augmented_batches([pack_folder], TrainingConfig(pairs=24, encoder=shape), seed=0)
    return [(planes, (torch.arange(len(planes)) < queries).float()) for planes, queries in islice(batches, 4)]


@pytest.fixture
def exported(shape, views, tmp_path):
    """Return an encoder with non-trivial normalisation: random statistics, factors and offsets."""
    torch.manual_seed(1)
    net = EncoderNet(shape).train()
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.uniform_(module.bias, -0.3, 0.3)
    with torch.no_grad():
        for planes, side in views * 5:
            net(planes, side)
    export(net, tmp_path / "encoder.onnx", trained_on=("city-1000",))
    return tmp_path / "encoder.onnx"


def descriptors_of(encoder, planes, side):
    both = {flag: encoder.encode(np.ascontiguousarray(planes.numpy()), flag) for flag in ("survey", "query")}
    return np.where(side.numpy()[:, None] > 0, both["query"], both["survey"])


def test_the_network_equals_the_encoder_in_evaluation_and_in_training(shape, exported, views):
    net = net_of(exported, shape, *views[0])
    planes, side = views[0]
    expected = descriptors_of(Encoder.open(exported), planes, side)
    with torch.no_grad():
        np.testing.assert_allclose(net(planes, side).numpy(), expected, atol=2e-4)
        # in training mode the statistics are those of the batch, here the one that they were taken from
        np.testing.assert_allclose(net.train()(planes, side).numpy(), expected, atol=5e-3)


def test_other_views_have_the_same_descriptors_too(shape, exported, views):
    planes, side = views[1]
    with torch.no_grad():
        found = net_of(exported, shape, *views[0])(planes, side).numpy()
    np.testing.assert_allclose(found, descriptors_of(Encoder.open(exported), planes, side), atol=2e-4)


def test_an_encoder_in_eight_bits_is_read_too(shape, exported, views, tmp_path):
    drawn = [Views(np.ascontiguousarray(planes.numpy()), int(side.sum())) for planes, side in views]
    quantise(exported, tmp_path / "eight.onnx", drawn[:2], drawn[2:])
    planes, side = views[1]
    with torch.no_grad():
        found = net_of(tmp_path / "eight.onnx", shape, *views[0])(planes, side).numpy()
    cosine = (found * descriptors_of(Encoder.open(exported), planes, side)).sum(axis=1)
    assert cosine.min() > 0.99


def test_a_run_may_start_from_an_exported_encoder(shape, exported, pack_folder, tmp_path, views):
    still = TrainingConfig(steps=1, pairs=24, learning_rate=0.0, weight_decay=0.0, encoder=shape)
    net = train([pack_folder], tmp_path / "run", still, device="cpu", start_from=exported)
    read = net_of(exported, shape, *views[0])
    torch.testing.assert_close(net.full12.weight, read.full12.weight, rtol=0, atol=0)
    # what the encoder had been trained on is remembered
    assert read_packs(tmp_path / "run") == ["encoder-city-1000", pack_folder.name]


def test_a_finished_run_does_not_start_again(shape, exported, pack_folder, tmp_path):
    config = TrainingConfig(steps=2, pairs=24, learning_rate=1e-2, encoder=shape)
    steps = []
    for _ in range(2):
        net = train(
            [pack_folder],
            tmp_path / "run",
            config,
            device="cpu",
            start_from=exported,
            report=lambda p: steps.append(p.step),
        )
    assert steps == [1, 2]
    torch.testing.assert_close(net.full12.weight, load_run(tmp_path / "run").full12.weight, rtol=0, atol=0)


def test_an_encoder_of_another_shape_is_refused(exported, shape, views):
    other = EncoderShape.model_validate(shape.model_dump() | {"narrow": shape.narrow + 1})
    with pytest.raises(EncoderError, match=r"encoder\.onnx: it has the shape"):
        net_of(exported, other, *views[0])


@pytest.mark.parametrize("kind", ["nothing", "empty folder", "broken file", "another shape", "run of another shape"])
def test_an_unusable_start_model_is_refused_before_anything_is_written(kind, exported, shape, pack_folder, tmp_path):
    other = EncoderShape.model_validate(shape.model_dump() | {"narrow": shape.narrow + 1})
    start, wanted = tmp_path / "start", shape
    if kind == "empty folder":
        start.mkdir()
    elif kind == "broken file":
        start.write_bytes(b"no model")
    elif kind == "another shape":
        start, wanted = exported, other
    elif kind == "run of another shape":
        train([pack_folder], start, TrainingConfig(steps=1, pairs=24, encoder=other), device="cpu")
    with pytest.raises((DatasetError, EncoderError), match=start.name):
        train(
            [pack_folder],
            tmp_path / "run",
            TrainingConfig(steps=1, pairs=24, encoder=wanted),
            device="cpu",
            start_from=start,
        )
    assert not (tmp_path / "run").exists()


def test_an_encoder_of_other_layers_is_refused(exported, shape, views, tmp_path):
    model = onnx.load(exported)
    last = next(node for node in model.graph.node if node.op_type == "Gemm")
    last.op_type, last.domain = "MatMul", ""
    del last.attribute[:], last.input[2:]
    weight = next(each for each in model.graph.initializer if each.name == last.input[1])
    values = onnx.numpy_helper.to_array(weight).T.copy()
    weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(EncoderError, match="11 layers with weights, not 12"):
        net_of(tmp_path / "other.onnx", shape, *views[0])


def test_an_encoder_that_is_missing_is_named(shape, views, tmp_path):
    with pytest.raises(EncoderError, match=r"nowhere\.onnx"):
        net_of(tmp_path / "nowhere.onnx", shape, *views[0])
