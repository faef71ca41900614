import os
import signal

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.augment import Augmentation, Augmenter  # noqa: E402  # after the skip
from model_training.training.batches import City  # noqa: E402
from model_training.training.loop import TrainingConfig, load_run, train, views_of  # noqa: E402
from model_training.training.memory import DescriptorMemory  # noqa: E402
from model_training.training.packs import Pack  # noqa: E402
from service.errors import DatasetError  # noqa: E402
from service.imaging.view_grid import PLANES, ViewGrid  # noqa: E402

GENTLE = Augmentation(
    blocked=0,
    small_blocks=0,
    narrow_rows=0,
    narrow_columns=0,
    short_range=0,
    invented_depth=0,
    unseen_top_rows=0,
    no_intensity=1,
    no_brightness=1,  # the pack's colours are noise
)


@pytest.fixture
def config(shape):
    return TrainingConfig(
        steps=15,
        pairs=24,
        learning_rate=1e-2,
        warm_up_steps=2,
        encoder=shape,
        augmentation=GENTLE,
        memory_after=4,
        alike_seeds=3,
        alike_each=3,
    )


def run_of(pack_folder, run, config, **options):
    return train([pack_folder], run, config, device="cpu", **options)


def assert_same_weights(one, other):
    for name, weights in one.state_dict().items():
        torch.testing.assert_close(weights, other.state_dict()[name], rtol=0, atol=0, msg=name)


@pytest.mark.parametrize(("optimiser", "rate"), [("adamw", 1e-2), ("sgdm", 3e-2)])
def test_the_loss_falls(pack_folder, tmp_path, config, optimiser, rate):
    losses = []
    changed = TrainingConfig.model_validate(
        config.model_dump()
        | {"optimiser": optimiser, "learning_rate": rate, "memory_after": 100, "turn_deg": 2.0, "steps": 30}
    )  # more negatives would raise the loss, and so few steps learn no turns
    run_of(pack_folder, tmp_path / "run", changed, report=lambda progress: losses.append(progress.loss))
    assert len(losses) == 30
    assert np.mean(losses[-3:]) < 0.9 * np.mean(losses[:3])


def test_one_seed_gives_one_encoder(pack_folder, tmp_path, config):
    assert_same_weights(*(run_of(pack_folder, tmp_path / name, config) for name in ("one", "other")))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_was_interrupted_goes_on_to_the_same_weights(pack_folder, tmp_path, config, number):
    before = signal.getsignal(number)

    def interrupt(progress):
        if progress.step == 6:
            os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt):
        run_of(pack_folder, tmp_path / "cut", config, report=interrupt)
    assert signal.getsignal(number) == before
    steps = []
    resumed = run_of(pack_folder, tmp_path / "cut", config, report=lambda progress: steps.append(progress.step))
    assert steps[0] in (7, 8)
    assert_same_weights(resumed, run_of(pack_folder, tmp_path / "whole", config))


@pytest.mark.parametrize(("second", "saved"), [(signal.SIGTERM, 6), (signal.SIGINT, None)])
def test_a_second_sigterm_does_not_prevent_the_checkpoint_but_ctrl_c_does(pack_folder, tmp_path, config, second, saved):
    """A cluster sends SIGTERM to all processes, and torchrun then sends its own one."""

    def interrupt(progress):
        if progress.step == 6:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), second)

    with pytest.raises(KeyboardInterrupt):
        run_of(pack_folder, tmp_path / "cut", config, report=interrupt)
    checkpoint = tmp_path / "cut" / "checkpoint.pt"
    assert (torch.load(checkpoint)["step"] if checkpoint.exists() else None) == saved


def test_a_finished_run_is_not_trained_again(pack_folder, tmp_path, config):
    first = run_of(pack_folder, tmp_path / "run", config)
    steps = []
    again = run_of(pack_folder, tmp_path / "run", config, report=lambda progress: steps.append(progress.step))
    assert steps == []
    assert_same_weights(first, again)


def test_a_folder_of_another_configuration_is_refused(pack_folder, tmp_path, config):
    run_of(pack_folder, tmp_path / "run", config.model_copy(update={"steps": 1}))
    before = (tmp_path / "run" / "config.json").read_bytes()
    with pytest.raises(DatasetError, match="another configuration"):
        run_of(pack_folder, tmp_path / "run", config)
    assert (tmp_path / "run" / "config.json").read_bytes() == before


def test_a_run_is_read_back_for_use(pack_folder, tmp_path, config):
    net = run_of(pack_folder, tmp_path / "run", config.model_copy(update={"steps": 2}))
    assert_same_weights(net, load_run(tmp_path / "run"))
    assert not load_run(tmp_path / "run").training


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="streetfix train"):
        load_run(tmp_path)


def test_a_run_may_start_from_anothers_weights(pack_folder, tmp_path, config):
    before = run_of(pack_folder, tmp_path / "before", config.model_copy(update={"steps": 2}))
    still = config.model_copy(update={"steps": 1, "learning_rate": 0.0, "weight_decay": 0.0})
    after = run_of(pack_folder, tmp_path / "after", still, start_from=tmp_path / "before")
    torch.testing.assert_close(after.full12.weight, before.full12.weight, rtol=0, atol=0)


def test_a_run_is_logged_for_tensorboard(pack_folder, tmp_path, config):
    run_of(pack_folder, tmp_path / "run", config)
    assert [path.name.split(".")[0] for path in (tmp_path / "run" / "tensorboard").iterdir()] == ["events"]


def test_unknown_settings_are_refused():
    with pytest.raises(ValueError, match="stepps"):
        TrainingConfig.model_validate({"stepps": 3})


def test_half_precision_learns_as_well_and_leaves_float32_weights(pack_folder, tmp_path, config):
    losses = []
    changed = config.model_copy(update={"precision": "bfloat16", "memory_after": 100, "turn_deg": 2.0, "steps": 30})
    net = run_of(pack_folder, tmp_path / "run", changed, report=lambda progress: losses.append(progress.loss))
    assert np.mean(losses[-3:]) < 0.9 * np.mean(losses[:3])
    assert {parameter.dtype for parameter in net.parameters()} == {torch.float32}


def test_without_a_memory_no_earlier_descriptor_is_used(pack_folder, tmp_path, config, monkeypatch):
    asked = []
    recent = DescriptorMemory.recent
    monkeypatch.setattr(DescriptorMemory, "recent", lambda *given: asked.append(given) or recent(*given))
    run_of(pack_folder, tmp_path / "never", config.model_copy(update={"memory_after": None}))
    assert asked == []
    run_of(pack_folder, tmp_path / "later", config)
    assert len(asked) == config.steps - config.memory_after


def test_hard_negatives_may_be_chosen_without_stale_negatives(pack_folder, tmp_path, config, monkeypatch):
    """The batches are equal, but there are fewer negatives. So losses are lower once the memory is used."""
    found = {}
    for stale in (True, False):
        losses = found[stale] = []
        changed = config.model_copy(update={"stale_negatives": stale, "learning_rate": 0.0})
        run_of(pack_folder, tmp_path / str(stale), changed, report=lambda progress, to=losses: to.append(progress.loss))
    first = config.memory_after
    np.testing.assert_allclose(found[True][:first], found[False][:first])
    assert all(few < many for many, few in zip(found[True][first:], found[False][first:], strict=True))


def test_blind_planes_are_zero_in_queries_alone(pack_folder, shape):
    grid = ViewGrid(rows=shape.rows, columns=shape.columns)
    batch = City(Pack.open(pack_folder), grid, turn_deg=2.0).draw(8, np.random.default_rng(0))

    def views(blind):
        augment = Augmenter(Augmentation(), grid, torch.Generator().manual_seed(0), torch.device("cpu"))
        return views_of(batch, augment, torch.device("cpu"), blind=blind)

    count, blind = len(batch.query_xy), ("range_m", "height_m")
    all_planes, found = views(()), views(blind)
    rows = [PLANES.index(name) for name in blind]
    assert (all_planes[:count, rows] != 0).any()
    assert (found[:count, rows] == 0).all()
    others = [k for k in range(len(PLANES)) if k not in rows]
    torch.testing.assert_close(found[:count, others], all_planes[:count, others])
    torch.testing.assert_close(found[count:], all_planes[count:])
