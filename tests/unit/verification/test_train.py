import numpy as np
import pytest

torch = pytest.importorskip("torch")

from model_training.verification.examples import ANSWER, BESIDE, STEPS, Examples  # noqa: E402
from model_training.verification.made_with import MadeWith  # noqa: E402
from model_training.verification.net import VerifierNet  # noqa: E402
from model_training.verification.train import VerifierTraining, export_verifier, train_verifier  # noqa: E402
from service.errors import DatasetError, EncoderError  # noqa: E402
from service.scoring.comparison import COLUMNS, PLANES, ROWS  # noqa: E402
from service.scoring.verifier import Verifier  # noqa: E402

# torch's tracing exporter is deprecated in favour of one that needs a newer runtime than the service has
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")

DIFFERENCE = PLANES.index("difference_sigmas")


def city(seed, count=48):
    """Return examples whose depth agrees with the map where the pose is right."""
    rng = np.random.default_rng(seed)
    right = rng.random(count) < 0.5
    planes = np.zeros((count, len(PLANES), ROWS, COLUMNS), np.int8)
    planes[:, [PLANES.index(name) for name in ("measured", "mapped", "in_view")]] = STEPS
    noise = rng.normal(0, 10, (count, ROWS, COLUMNS))
    planes[:, DIFFERENCE] = np.clip(noise + np.where(right, 0, -90)[:, None, None], -STEPS, STEPS)
    origin = rng.choice(np.array([ANSWER, BESIDE], np.uint8), count)
    return Examples(planes, np.where(right, 0.3, np.inf).astype(np.float32), origin)


def test_the_network_learns_what_agrees(tmp_path):
    reported = []
    net, loss = train_verifier(
        [city(0), city(1)], VerifierTraining(epochs=4, batch=16), report=lambda *given: reported.append(given)
    )
    assert loss < 0.5
    assert reported[0] == ("epoch 1 of 4", 1, 6)
    assert reported[-1] == ("epoch 4 of 4", 6, 6)
    out = tmp_path / "verifier.onnx"
    assert export_verifier(net, out) < 1e-3
    unseen = city(2)
    odds = Verifier.open(out).log_odds(list(unseen.planes.astype(np.float32) / STEPS))
    right = unseen.error_m <= 1
    assert odds[right].min() > odds[~right].max()
    assert [path.name for path in tmp_path.iterdir()] == ["verifier.onnx"]


def test_the_same_seed_gives_the_same_network():
    one, same = (train_verifier([city(0)], VerifierTraining(epochs=1, batch=16))[0] for _ in range(2))
    for a, b in zip(one.state_dict().values(), same.state_dict().values(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("error_m", [0.1, 9.0])
def test_right_and_wrong_poses_are_needed(error_m):
    only = city(0)
    only.error_m[:] = error_m
    with pytest.raises(DatasetError, match="right and wrong poses") as refused:
        train_verifier([only], VerifierTraining())
    assert refused.value.field == "cities"


def test_a_network_that_onnx_runtime_computes_otherwise_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(Verifier, "log_odds", lambda _, comparisons: np.full(len(comparisons), 1e3, np.float32))
    with pytest.raises(EncoderError, match="nothing was written"):
        export_verifier(VerifierNet(), tmp_path / "verifier.onnx")
    assert not list(tmp_path.iterdir())


def test_a_network_with_weights_that_are_no_numbers_is_not_written(tmp_path):
    net = VerifierNet()
    with torch.no_grad():
        next(net.head.parameters()).fill_(np.nan)
    with pytest.raises(EncoderError, match=r"differ by nan.*nothing was written; train again") as refused:
        export_verifier(net, tmp_path / "verifier.onnx")
    assert refused.value.field == "verifier"
    assert not list(tmp_path.iterdir())


def test_a_network_that_cannot_be_opened_is_not_written(tmp_path, monkeypatch):
    def refused(_):
        raise EncoderError("the verifier returns something else")

    monkeypatch.setattr(Verifier, "open", refused)
    with pytest.raises(EncoderError, match="something else"):
        export_verifier(VerifierNet(), tmp_path / "verifier.onnx")
    assert not list(tmp_path.iterdir())


def test_examples_survive_a_file(tmp_path):
    made_with = MadeWith("ab" * 32, "cd" * 8, PLANES)
    city(3).write(tmp_path / "examples.npz", made_with)
    assert MadeWith.read(tmp_path / "examples.npz") == made_with
    found = Examples.read(tmp_path / "examples.npz")
    for name in Examples.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(city(3), name))
    assert [path.name for path in tmp_path.iterdir()] == ["examples.npz"]


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "examples.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(DatasetError, match=r"examples\.npz.*remove it"):
        Examples.read(tmp_path / "examples.npz")
