"""Answer queries that ``streetfix evaluate`` does not ask: several frames or cameras, priors, given heights, and tracks.

``benchmarks.same_answers`` runs this file with two versions of the code. So it uses only names that both versions have.

Example: python benchmarks/several_frames.py data/frames
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import Predictions, predict
from model_training.evaluation.tracks import drives_of, followed
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from model_training.stock import ENCODER
from service.geometry.rigid import Transform
from service.imaging.level import GivenHeight
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.prior import Prior
from service.retrieval.query import Query

#: Frames of a sequence, and cameras around the vehicle.
FRAMES, CAMERAS = 5, 4
#: Standard deviation of a prior, m.
PRIOR_M = 5.0
#: Low camera of all queries, and the given height, m. The height is not given in most of the queries.
CAMERA_M, GIVEN = 0.6, GivenHeight(0.6, 0.1)


def plan() -> SimulationPlan:
    """Plan a small city with single queries, sequences, and queries of several cameras."""
    stereo = ("stereo",)
    return SimulationPlan(
        name="frames",
        seed=7104,
        size_m=(120.0, 150.0),
        camera_height_m=CAMERA_M,
        queries=(
            QueryPlan(name="single", traversal=1, count=30, depths=stereo),
            QueryPlan(name="sequence", traversal=2, count=12, sequence=FRAMES, step_m=2.0, depths=stereo),
            QueryPlan(name="around", traversal=3, count=10, cameras=CAMERAS, depths=stereo),
        ),
    )


def right_prior(T_map_camera: Transform, rng: np.random.Generator) -> Prior:
    """Return a prior whose error agrees with its standard deviation.

    Args:
        T_map_camera: true pose (4, 4).
        rng: source of randomness.
    """
    return Prior(position_m=T_map_camera[:2, 3] + rng.normal(0, PRIOR_M, 2), position_std_m=PRIOR_M)


def wrong_prior(T_map_camera: Transform, _rng: np.random.Generator) -> Prior:
    """Return a prior that is wrong by several standard deviations.

    Args:
        T_map_camera: true pose (4, 4).
        _rng: unused.
    """
    return Prior(position_m=T_map_camera[:2, 3] + [4 * PRIOR_M, 0.0], position_std_m=PRIOR_M)


def with_height(query: Query) -> Query:
    """Return a query with the height of its camera.

    Args:
        query: the query.
    """
    return replace(query, camera_height=GIVEN)


def answers(localizer: Localizer, dataset: Dataset) -> dict[str, Predictions]:
    """Answer all queries; return the answers by name.

    Args:
        localizer: of the map of the dataset.
        dataset: dataset of ``plan``.
    """
    return {
        "single": predict(localizer, dataset, "single_stereo"),
        "given_height": predict(localizer, dataset, "single_stereo", seen_by=with_height),
        "right_prior": predict(localizer, dataset, "single_stereo", prior_of=right_prior),
        "wrong_prior": predict(localizer, dataset, "single_stereo", prior_of=wrong_prior),
        "sequences": predict(localizer, dataset, "sequence_stereo", frames_each=FRAMES),
        "cameras": predict(localizer, dataset, "around_stereo", frames_each=CAMERAS),
    }


def main(folder: Path) -> None:
    """Make the dataset and its map, answer all queries, and write ``FOLDER/answers``.

    Args:
        folder: an empty folder.
    """
    simulate(plan(), folder / "data")
    dataset = Dataset(folder / "data")
    build_map(dataset, ENCODER, folder / "map", BuildSettings(name="frames"))
    localizer = Localizer.open(MapBundle.open(folder / "map"))
    (folder / "answers").mkdir()
    for name, found in answers(localizer, dataset).items():
        found.save(folder / "answers" / f"{name}.npz")
    tracks = followed(localizer, drives_of(dataset, "sequence_stereo", FRAMES))
    np.savez(
        folder / "answers" / "tracks.npz",
        T_true=np.zeros((tracks.accepted.size, 0)),  # one row per answer, as in the other files
        accepted=tracks.accepted,
        error_m=tracks.error_m,
        epoch=tracks.epoch,
        frames=tracks.frames,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
