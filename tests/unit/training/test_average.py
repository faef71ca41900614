import json

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.augment import Augmentation  # noqa: E402  # after the skip
from model_training.training.average import average  # noqa: E402
from model_training.training.encoder_net import EncoderShape  # noqa: E402
from model_training.training.loop import TrainingConfig, load_run, train  # noqa: E402
from service.errors import DatasetError  # noqa: E402

SHAPE = EncoderShape(rows=16, columns=32, widths=(4, 4, 8, 8), narrow=4, descriptor=8)


@pytest.fixture(scope="module")
def runs(pack_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    config = TrainingConfig(steps=2, pairs=8, encoder=SHAPE, augmentation=Augmentation())
    train([pack_folder], folder / "first", config, device="cpu")
    train([pack_folder], folder / "second", config, device="cpu", start_from=folder / "first")
    other = config.model_copy(update={"encoder": SHAPE.model_copy(update={"descriptor": 4})})
    train([pack_folder], folder / "other", other, device="cpu")
    return folder


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_weights_are_the_mean_of_both_by_their_share(runs, pack_folder, tmp_path, share):
    average(runs / "first", runs / "second", [pack_folder], tmp_path / "mean", share=share, batches=2)
    first, second, mean = (
        dict(load_run(run).named_parameters()) for run in (runs / "first", runs / "second", tmp_path / "mean")
    )
    for name, value in mean.items():
        torch.testing.assert_close(value, (1 - share) * first[name] + share * second[name])


def test_statistics_are_computed_again_over_the_batches(runs, pack_folder, tmp_path):
    """A network averaged with itself has equal weights and data, so only random effects remain."""
    seen = []
    one = average(runs / "first", runs / "first", [pack_folder], tmp_path / "one", batches=20, report=seen.append)
    other = average(runs / "first", runs / "first", [pack_folder], tmp_path / "other", batches=20, seed=1)
    norms = [(a, b) for a, b in zip(one.modules(), other.modules(), strict=True) if isinstance(a, torch.nn.BatchNorm2d)]
    assert len(norms) == 10
    for a, b in norms:
        assert int(a.num_batches_tracked) == 20
        assert not torch.equal(a.running_mean, b.running_mean)
        spread = a.running_var.sqrt()
        assert float(((a.running_mean - b.running_mean).abs() / spread).max()) < 0.5
    assert seen == list(range(1, 21))
    assert not one.training


def test_the_mean_is_a_run_like_any_other(runs, pack_folder, tmp_path):
    average(runs / "first", runs / "second", [pack_folder], tmp_path / "mean", batches=1)
    assert json.loads((tmp_path / "mean" / "packs.json").read_text()) == [pack_folder.name]
    config = TrainingConfig(steps=1, pairs=8, encoder=SHAPE)
    train([pack_folder], tmp_path / "third", config, device="cpu", start_from=tmp_path / "mean")


def test_values_without_a_mean_are_refused_and_nothing_is_written(runs, pack_folder, tmp_path):
    with pytest.raises(DatasetError, match="must have the same shape"):
        average(runs / "first", runs / "other", [pack_folder], tmp_path / "mean")
    with pytest.raises(DatasetError, match=r"checkpoint\.pt"):
        average(runs / "first", tmp_path, [pack_folder], tmp_path / "mean")
    with pytest.raises(DatasetError, match="already contains a run"):
        average(runs / "first", runs / "second", [pack_folder], runs / "other")
    assert not (tmp_path / "mean").exists()
