"""A street of identical blocks with a landmark every few blocks. A single image cannot distinguish the blocks."""

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.buildings import FacadeStyle, Footprint, add_building
from model_training.simulation.city import City
from model_training.simulation.meshes import Material, Mesh, MeshBuilder, cone
from model_training.simulation.street_life import add_furniture, add_person, add_tree
from model_training.simulation.streets import Street
from model_training.simulation.terrain import GroundPicture, Terrain

#: Length of a block, metres.
BLOCK_M = 36.0
#: Number of blocks.
BLOCKS = 20
#: Number of blocks from one landmark to the next, and the index of the first landmark's block.
LANDMARK_EVERY, FIRST_LANDMARK = 5, 2
#: Half width of the carriageway and width of the pavement, metres.
_HALF_WIDTH_M, _PAVEMENT_M = 4.2, 2.2


def landmarks_m() -> NDArray[np.float64]:
    """Return the middles (n,) of the landmark blocks along the street: x in the map frame, metres."""
    numbers = np.arange(FIRST_LANDMARK, BLOCKS, LANDMARK_EVERY)
    middles: NDArray[np.float64] = (numbers.astype(np.float64) + 0.5 - BLOCKS / 2) * BLOCK_M
    return middles


class RepeatingCity(City):
    """One straight, level street along x. No cars park there, because parked cars would be landmarks.

    Args:
        seed: seed of the repeated block and of the landmarks.
    """

    def __init__(self, *, seed: int) -> None:  # City's own places random objects along streets
        self.seed, self.name = seed, "repeating"
        half_m = BLOCKS * BLOCK_M / 2
        points = 3 * BLOCKS + 1  # every third piece has a road marking: one per block, always at the same position
        line = np.stack([np.linspace(-half_m, half_m, points), np.zeros(points)], axis=1)
        self.streets = [Street("1", (line,), _HALF_WIDTH_M, True)]
        self.half_size_m = (half_m + 20.0, 60.0)
        self.terrain = Terrain(np.zeros((1, 4)))
        self.ground = GroundPicture.of(self.streets, self.half_size_m)
        builder = MeshBuilder()
        self.terrain.add_to(builder, self.half_size_m)
        landmarks = set(np.arange(FIRST_LANDMARK, BLOCKS, LANDMARK_EVERY).tolist())
        for number in range(BLOCKS):
            start_m = number * BLOCK_M - half_m
            for side in (-1.0, 1.0):
                if number in landmarks:
                    _block(builder, start_m, side, np.random.default_rng([seed, 43, number]), tower=True)
                else:
                    _block(builder, start_m, side, np.random.default_rng([seed, 42]), tower=False)
        self.static = builder.mesh()

    def occupants(self, traversal: int, *, parked_changed: float = 0.5) -> Mesh:  # noqa: ARG002  # nobody parks here
        """Return the mesh of the people of one traversal. They differ between traversals.

        Args:
            traversal: number of the traversal.
            parked_changed: without effect, because no cars park here.
        """
        builder = MeshBuilder()
        rng = np.random.default_rng([self.seed, 44, traversal])
        for x in np.arange(-self.half_size_m[0] + 25, self.half_size_m[0] - 25, 9.0):
            if rng.random() < 0.25:
                y = rng.choice([-1, 1]) * (_HALF_WIDTH_M + rng.uniform(0.5, 1.8))
                add_person(builder, np.array([x + rng.normal(0, 3), y, 0.0]), rng.uniform(-np.pi, np.pi), rng)
        return builder.mesh()


def _block(builder: MeshBuilder, start_m: float, side: float, rng: np.random.Generator, *, tower: bool) -> None:
    """Add houses, a tree, a piece of furniture and perhaps a tower on one side of the street."""
    edge, u = side * (_HALF_WIDTH_M + _PAVEMENT_M), 0.0
    while u < BLOCK_M - 6:
        width, depth, height = rng.uniform(8, 14), rng.uniform(8, 12), rng.uniform(6, 16)
        width = min(width, BLOCK_M - u - 1.0)
        centre = np.array([start_m + u + width / 2, edge + side * (rng.uniform(0, 1.5) + depth / 2), 0.0])
        plan = Footprint(centre, width, depth, height, 0.0 if side > 0 else np.pi)
        add_building(builder, plan, FacadeStyle.random(rng), roof="flat", lively=0.45, rng=rng)
        u += width + rng.uniform(0.5, 4.0)
    for k in range(2):
        at = np.array([start_m + BLOCK_M * (0.25 + 0.5 * k) + rng.uniform(-4, 4), side * (_HALF_WIDTH_M + 1.0), 0.0])
        if k == 0:
            add_tree(builder, at, rng)
        else:
            add_furniture(builder, at, 0.0, rng)
    if tower:
        at = np.array([start_m + BLOCK_M / 2, side * (_HALF_WIDTH_M + 1.2), 0.0])
        size, height = rng.uniform(0.8, 1.6), rng.uniform(3, 7)
        builder.box(
            at - [0, 0, 0.3], (size, size, height + 0.3), rng.uniform(0, 1.5), rng.uniform(0.2, 0.8, 3), Material.MATTE
        )
        builder.triangles(cone(at + [0, 0, height], size, rng.uniform(1, 3)), rng.uniform(0.2, 0.8, 3), Material.MATTE)
