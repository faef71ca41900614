import numpy as np
import onnx
import pytest

from model_training.stock import ENCODER
from service.errors import EncoderError
from service.scoring.comparison import COLUMNS, PLANES, ROWS
from service.scoring.verifier import SHIPPED, Verifier


def comparison(*, agrees: bool):
    """Return a street with a wall at 8 m that the map has at the same distance, or at 4 m."""
    planes = np.zeros((len(PLANES), ROWS, COLUMNS), np.float32)
    for name in ("measured", "mapped", "in_view"):
        planes[PLANES.index(name)] = 1
    planes[PLANES.index("inverse_depth")] = planes[PLANES.index("mapped_inverse_depth")] = 0.5
    if not agrees:
        planes[PLANES.index("mapped_inverse_depth")] = 1.0
        planes[PLANES.index("difference_sigmas")] = planes[PLANES.index("difference_ratio")] = -0.9
    planes[PLANES.index("relative_noise")] = 0.05
    return planes


def test_the_shipped_verifier_prefers_a_map_that_agrees():
    right, wrong = Verifier.shipped().log_odds([comparison(agrees=True), comparison(agrees=False)])
    assert right > wrong + 1


def test_comparisons_are_independent_of_each_other():
    one, other = comparison(agrees=True), comparison(agrees=False)
    verifier = Verifier.shipped()
    together = verifier.log_odds([one, other] * 3)
    assert together.dtype == np.float32
    assert together.shape == (6,)
    np.testing.assert_array_equal(together[::2], verifier.log_odds([one])[0])
    np.testing.assert_array_equal(together[1::2], verifier.log_odds([other])[0])
    assert together[0] != together[1]


def test_no_comparisons_have_no_log_odds():
    found = Verifier.shipped().log_odds([])
    assert found.dtype == np.float32
    assert found.shape == (0,)


def test_an_empty_comparison_has_finite_log_odds():
    assert np.isfinite(Verifier.shipped().log_odds([np.zeros((len(PLANES), ROWS, COLUMNS), np.float32)])).all()


def test_the_shipped_verifier_is_opened_once():
    assert Verifier.shipped() is Verifier.shipped()
    assert Verifier.open(SHIPPED) is not Verifier.shipped()


@pytest.fixture
def shipped_at(monkeypatch):
    """Return a function that opens a file as the shipped verifier."""

    def opened(path):
        monkeypatch.setattr("service.scoring.verifier.SHIPPED", path)
        Verifier.shipped.cache_clear()
        return Verifier.shipped()

    yield opened
    Verifier.shipped.cache_clear()


def test_a_missing_shipped_file_needs_a_new_installation(shipped_at, tmp_path):
    with pytest.raises(EncoderError, match=r"absent\.onnx.*; install Streetfix again$") as refused:
        shipped_at(tmp_path / "absent.onnx")
    assert refused.value.field == "verifier"


@pytest.mark.parametrize("content", [b"no network", b""])
def test_a_damaged_shipped_file_needs_a_new_installation(shipped_at, tmp_path, content):
    (tmp_path / "bad.onnx").write_bytes(content)
    with pytest.raises(EncoderError, match=r"bad\.onnx: ONNX Runtime cannot load.*; install Streetfix again$"):
        shipped_at(tmp_path / "bad.onnx")


def test_another_network_in_place_of_the_shipped_one_needs_a_new_installation(shipped_at):
    with pytest.raises(EncoderError, match=r"comparison -> log_odds are expected.*; install Streetfix again$"):
        shipped_at(ENCODER)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(EncoderError, match=r"absent\.onnx") as refused:
        Verifier.open(tmp_path / "absent.onnx")
    assert refused.value.field == "verifier"


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "bad.onnx").write_bytes(b"no network")
    with pytest.raises(EncoderError, match=r"bad\.onnx.*train-verifier"):
        Verifier.open(tmp_path / "bad.onnx")


def test_the_content_of_a_file_is_a_verifier_too():
    one = [comparison(agrees=True)]
    assert Verifier.open(SHIPPED.read_bytes()).log_odds(one) == Verifier.shipped().log_odds(one)
    with pytest.raises(EncoderError, match=r"the content: ONNX Runtime cannot load the verifier"):
        Verifier.open(b"no network")


def test_a_network_with_other_inputs_is_refused():
    with pytest.raises(
        EncoderError, match=r"comparison -> log_odds are expected.*12 planes of 64 x 128.*train-verifier"
    ):
        Verifier.open(ENCODER)


@pytest.fixture
def network_at(tmp_path):
    """Return a function that writes a network which averages a comparison."""

    def written(*, batch="batch", planes=12, output="log_odds", keeps_axes=False):
        helper, floats = onnx.helper, onnx.TensorProto.FLOAT
        averaged = [batch, 1, 1, 1] if keeps_axes else [batch]
        graph = helper.make_graph(
            [helper.make_node("ReduceMean", ["comparison"], [output], axes=[1, 2, 3], keepdims=int(keeps_axes))],
            "average",
            [helper.make_tensor_value_info("comparison", floats, [batch, planes, ROWS, COLUMNS])],
            [helper.make_tensor_value_info(output, floats, averaged)],
        )
        path = tmp_path / "average.onnx"
        path.write_bytes(
            helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()
        )
        return path

    return written


@pytest.mark.parametrize("batch", ["batch", 1])
def test_a_network_gives_the_log_odds_of_its_comparisons_in_their_order(network_at, batch):
    planes = [np.full((len(PLANES), ROWS, COLUMNS), value, np.float32) for value in (0.25, -0.5)]
    assert Verifier.open(network_at(batch=batch)).log_odds(planes) == pytest.approx([0.25, -0.5])


@pytest.mark.parametrize("changed", [{"batch": 2}, {"planes": 11}, {"output": "odds"}, {"keeps_axes": True}])
def test_a_network_with_other_planes_outputs_or_batches_is_refused(network_at, changed):
    with pytest.raises(EncoderError, match="comparison -> log_odds are expected") as refused:
        Verifier.open(network_at(**changed))
    assert refused.value.field == "verifier"
