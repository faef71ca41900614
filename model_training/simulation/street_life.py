"""Objects beside and on streets: trees of several kinds, furniture, vehicles, people."""

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder, blob, cone, leaves

Vector = NDArray[np.float64]

#: Linear albedo (n, 3) of vehicles.
CAR_COLOURS = np.array([[.75, .75, .76], [.08, .08, .09], [.30, .31, .33], [.55, .06, .06], [.07, .12, .35], [.85, .85, .84],
                        [.12, .22, .14], [.45, .38, .25]])  # fmt: skip
#: Linear albedo (n, 3) of clothes.
CLOTHES = np.array(
    [[0.1, 0.12, 0.25], [0.5, 0.1, 0.1], [0.15, 0.15, 0.15], [0.55, 0.5, 0.4], [0.2, 0.35, 0.2], [0.7, 0.7, 0.72]]
)


def add_tree(builder: MeshBuilder, base: Vector, rng: np.random.Generator, *, kind: str | None = None) -> None:
    """Add a broad-leaved tree, a conifer, a poplar or a bare tree. Loose leaves let some LiDAR beams through.

    Args:
        builder: receives the triangles.
        base: foot of the trunk (3,), map frame, metres.
        rng: random generator.
        kind: ``broad``, ``conifer``, ``poplar`` or ``bare``; None draws the kind.
    """
    kind = kind or str(rng.choice(["broad", "broad", "broad", "conifer", "poplar", "bare"]))
    height = rng.uniform(4, 11) * (1.25 if kind == "poplar" else 1.0)
    trunk = rng.uniform(0.2, 0.55)
    bark = np.array([0.22, 0.16, 0.11]) * rng.uniform(0.8, 1.4)
    green = np.array([0.13, 0.22, 0.06]) * rng.uniform(0.7, 1.5) + rng.uniform(0, 0.05, 3) * [1, 0.6, 0.2]
    bottom = rng.uniform(0.22, 0.42) * height
    sunk = base - [0, 0, 0.6]
    if kind == "conifer":
        builder.box(sunk, (trunk * 0.7, trunk * 0.7, height * 0.6), rng.uniform(0, 1.5), bark, Material.MATTE)
        radius = rng.uniform(0.18, 0.28) * height
        for share in (0.12, 0.35, 0.58):
            tier = cone(base + [0, 0, height * share], radius * (1.1 - share), height * 0.42, 9)
            builder.triangles(tier, green * [0.7, 0.85, 0.9], Material.FOLIAGE)
        n = 140
        up = rng.random(n)
        ring = radius * (1.05 - up) * rng.uniform(0.7, 1.15, n)
        angle = rng.uniform(0, 2 * np.pi, n)
        points = base + np.stack([ring * np.cos(angle), ring * np.sin(angle), height * (0.1 + 0.85 * up)], axis=1)
        builder.triangles(leaves(points, 0.15, rng), green * [0.75, 0.9, 0.9], Material.FOLIAGE)
        return
    builder.box(sunk, (trunk, trunk, bottom + 1.6), rng.uniform(0, 1.5), bark, Material.MATTE)
    if kind == "bare":
        for _ in range(int(rng.integers(5, 10))):
            tip = base + [*rng.normal(0, 0.16 * height, 2), rng.uniform(0.6, 1.0) * height]
            fork = base + [0, 0, bottom + rng.uniform(0, 1.0)]
            side = np.cross(tip - fork, rng.normal(size=3))
            side *= 0.10 / np.linalg.norm(side)
            builder.triangles(np.array([[fork - side, fork + side, tip]]), bark, Material.MATTE)
            twigs = fork + (tip - fork) * rng.uniform(0.4, 1.1, (14, 1)) + rng.normal(0, 0.35, (14, 3))
            builder.triangles(leaves(twigs, 0.13, rng), bark * 1.2, Material.FOLIAGE)
        return
    crown = rng.uniform(0.22, 0.38) * height * (0.45 if kind == "poplar" else 1.0)
    for k in range(int(rng.integers(3, 6))):
        middle = base + [0, 0, bottom + crown] + rng.normal(0, 0.45 * crown, 3) * [1, 1, 0.8]
        if kind == "poplar":
            middle = base + [*rng.normal(0, 0.2 * crown, 2), bottom + crown * (1 + 1.3 * k)]
        radius = crown * rng.uniform(0.45, 0.8)
        builder.triangles(
            blob(middle, np.array([radius, radius, radius * 0.9]), rng),
            green * rng.uniform(0.85, 1.15),
            Material.FOLIAGE,
        )
        direction = rng.normal(size=(50, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        points = middle + direction * radius * rng.uniform(0.9, 1.45, (50, 1))
        builder.triangles(leaves(points, 0.18, rng), green * rng.uniform(0.8, 1.3, (50, 1)), Material.FOLIAGE)


def add_bush(builder: MeshBuilder, base: Vector, rng: np.random.Generator) -> None:
    """Add a bush.

    Args:
        builder: receives the triangles.
        base: ground point (3,), map frame, metres.
        rng: random generator.
    """
    radius = rng.uniform(0.4, 1.1)
    green = np.array([0.12, 0.2, 0.07]) * rng.uniform(0.7, 1.5)
    radii = np.array([radius, radius, radius * rng.uniform(0.6, 1.0)])
    builder.triangles(blob(base + [0, 0, radius * 0.5], radii, rng), green, Material.FOLIAGE)
    direction = rng.normal(size=(24, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    builder.triangles(
        leaves(base + [0, 0, radius * 0.5] + direction * radii * 1.05, 0.1, rng), green * 1.2, Material.FOLIAGE
    )


def add_furniture(builder: MeshBuilder, base: Vector, yaw: float, rng: np.random.Generator) -> None:
    """Add a lamp, a sign, a bin, a bench, an advertising board, a shelter or a cabinet.

    Args:
        builder: receives the triangles.
        base: ground point (3,), map frame, metres.
        yaw: heading of the street, radians, counter-clockwise from x.
        rng: random generator.
    """
    kind = rng.choice(["lamp", "lamp", "lamp", "sign", "sign", "bin", "bench", "cabinet", "hoarding", "shelter"])
    steel = np.array([0.35, 0.37, 0.38]) * rng.uniform(0.6, 1.3)
    low = base - [0, 0, 0.4]
    if kind == "lamp":
        height = rng.uniform(4, 8)
        builder.box(low, (0.16, 0.16, height), yaw, steel, Material.METAL)
        builder.box(base + [0, 0, height - 0.4], (1.3, 0.25, 0.15), yaw + np.pi / 2, steel, Material.METAL)
    elif kind == "sign":
        builder.box(low, (0.08, 0.08, 2.9), yaw, steel, Material.METAL)
        face = np.array([[0.7, 0.08, 0.08], [0.1, 0.2, 0.6], [0.8, 0.7, 0.1], [0.8, 0.8, 0.8]])[rng.integers(4)]
        builder.box(base + [0, 0, 1.9], (0.06, rng.uniform(0.5, 0.9), rng.uniform(0.5, 0.8)), yaw, face, Material.METAL)
    elif kind == "bin":
        builder.box(low, (0.6, 0.6, 1.4), yaw, np.array([0.1, 0.25, 0.12]), Material.MATTE)
    elif kind == "bench":
        builder.box(base + [0, 0, 0.35], (1.8, 0.5, 0.12), yaw, np.array([0.35, 0.22, 0.12]), Material.MATTE)
        builder.box(low, (1.6, 0.1, 0.9), yaw, steel, Material.METAL)
    elif kind == "cabinet":
        builder.box(
            low, (rng.uniform(0.6, 1.4), 0.45, rng.uniform(1.2, 2.0)), yaw, np.array([0.5, 0.52, 0.48]), Material.MATTE
        )
    elif kind == "hoarding":
        builder.box(low, (0.2, 0.2, 1.5), yaw, steel, Material.METAL)
        builder.box(
            base + [0, 0, 0.9],
            (rng.uniform(1.2, 2.8), 0.2, rng.uniform(1.5, 2.2)),
            yaw,
            rng.uniform(0.1, 0.8, 3),
            Material.MATTE,
        )
    else:
        builder.box(base + [0, 0, 2.3], (3.4, 1.5, 0.12), yaw, steel, Material.METAL)
        back = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * 0.7
        builder.box(low + back, (3.4, 0.06, 2.7), yaw, np.array([0.3, 0.35, 0.36]), Material.GLASS)


def add_vehicle(
    builder: MeshBuilder, base: Vector, yaw: float, rng: np.random.Generator, *, kind: str | None = None
) -> None:
    """Add a car, a van or a lorry on its wheels.

    Args:
        builder: receives the triangles.
        base: ground point below the centre (3,), map frame, metres.
        yaw: heading, radians, counter-clockwise from x.
        rng: random generator.
        kind: ``car``, ``van`` or ``lorry``; None draws the kind.
    """
    kind = kind or str(rng.choice(["car", "van", "lorry"], p=[0.88, 0.09, 0.03]))
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    colour = CAR_COLOURS[rng.integers(len(CAR_COLOURS))] * rng.uniform(0.8, 1.15)
    tyre = np.array([0.03, 0.03, 0.03])
    if kind == "car":
        length, width, height = rng.uniform(3.6, 5.0), rng.uniform(1.6, 1.9), rng.uniform(1.35, 1.9)
        builder.box(base + [0, 0, 0.25], (length, width, height * 0.5), yaw, colour, Material.METAL)
        cabin = base - 0.1 * length * ahead + [0, 0, 0.25 + height * 0.5]
        builder.box(
            cabin, (length * 0.58, width * 0.88, height * 0.4), yaw, np.array([0.08, 0.1, 0.12]), Material.GLASS
        )
        builder.box(cabin + [0, 0, height * 0.38], (length * 0.5, width * 0.84, 0.06), yaw, colour, Material.METAL)
        builder.box(base, (length * 0.8, width * 0.85, 0.3), yaw, tyre, Material.MATTE)
        return
    length, width, height = rng.uniform(5, 6.5), rng.uniform(1.9, 2.1), rng.uniform(2.1, 2.8)
    if kind == "lorry":
        length, width, height = rng.uniform(7, 10), 2.5, rng.uniform(3.2, 3.9)
        white = np.array([0.75, 0.75, 0.73]) * rng.uniform(0.5, 1.1)
        builder.box(
            base + ahead * (-1.2) + [0, 0, 0.9], (length - 2.4, width, height - 0.9), yaw, white, Material.METAL
        )
        builder.box(
            base + ahead * (length / 2 - 1.1) + [0, 0, 0.5], (2.1, width * 0.96, 2.3), yaw, colour, Material.METAL
        )
    else:
        builder.box(base + [0, 0, 0.3], (length, width, height - 0.3), yaw, colour, Material.METAL)
        builder.box(
            base + ahead * (length / 2 - 0.8) + [0, 0, 1.3],
            (1.62, width * 1.01, 0.7),
            yaw,
            np.array([0.08, 0.1, 0.12]),
            Material.GLASS,
        )
    builder.box(base, (length * 0.85, width * 0.85, 0.9), yaw, tyre, Material.MATTE)


def add_person(builder: MeshBuilder, base: Vector, yaw: float, rng: np.random.Generator) -> None:
    """Add a standing or walking person.

    Args:
        builder: receives the triangles.
        base: ground point (3,), map frame, metres.
        yaw: heading, radians, counter-clockwise from x.
        rng: random generator.
    """
    height = rng.uniform(1.5, 1.9)
    legs, coat = CLOTHES[rng.integers(len(CLOTHES))], CLOTHES[rng.integers(len(CLOTHES))]
    stride = rng.uniform(0.0, 0.3)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    for sign in (-1, 1):
        builder.box(base + sign * stride * ahead, (0.18, 0.2, height * 0.48), yaw, legs, Material.MATTE)
    builder.box(base + [0, 0, height * 0.45], (0.28, 0.48, height * 0.4), yaw, coat, Material.MATTE)
    builder.box(
        base + [0, 0, height * 0.86], (0.2, 0.2, height * 0.14), yaw, np.array([0.6, 0.42, 0.33]), Material.MATTE
    )
