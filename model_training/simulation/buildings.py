"""Buildings with façade relief: windows, doors, balconies, awnings, steps; flat, gabled and hipped roofs."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.meshes import Material, MeshBuilder

#: Linear albedo (n, 3) of walls.
PLASTERS = np.array([[.72, .66, .55], [.80, .76, .68], [.62, .45, .36], [.68, .60, .42], [.55, .57, .58], [.74, .58, .46],
                     [.48, .50, .46], [.83, .80, .74], [.60, .38, .30], [.45, .36, .32]])  # fmt: skip
#: Linear albedo (n, 3) of roofs.
ROOFS = np.array([[0.45, 0.20, 0.14], [0.30, 0.22, 0.20], [0.25, 0.26, 0.28], [0.38, 0.30, 0.24]])
#: Linear albedo (n, 3) of awnings.
AWNINGS = np.array([[0.6, 0.1, 0.1], [0.1, 0.3, 0.15], [0.1, 0.15, 0.45], [0.7, 0.6, 0.2], [0.75, 0.75, 0.72]])
#: Linear albedo (3,) of window glass.
GLASS = np.array([0.10, 0.13, 0.16])


@dataclass(frozen=True)
class FacadeStyle:
    """Dimensions of a façade, metres.

    Attributes:
        storey: height of a storey.
        bay: target distance between window axes.
        window_width: width of a window.
        window_height: height of a window.
        relief: depth of the wall in front of the glass.
        sill: height of a window's lower edge above its floor.
    """

    storey: float
    bay: float
    window_width: float
    window_height: float
    relief: float
    sill: float

    @staticmethod
    def random(rng: np.random.Generator) -> "FacadeStyle":
        """Draw a style within the ranges of real streets.

        Args:
            rng: random generator.
        """
        return FacadeStyle(
            storey=rng.uniform(2.8, 3.8),
            bay=rng.uniform(2.0, 5.0),
            window_width=rng.uniform(0.9, 2.0),
            window_height=rng.uniform(1.2, 2.1),
            relief=rng.uniform(0.08, 0.4),
            sill=rng.uniform(0.3, 1.1),
        )


@dataclass(frozen=True)
class Footprint:
    """Position and size of a building.

    Attributes:
        centre: centre of the footprint on the ground (3,), map frame, metres.
        width: size along the street, metres.
        depth: size across the street, metres.
        height: height of the walls, metres.
        yaw: heading of the width axis, radians, counter-clockwise from x. The front faces yaw - 90 degrees.
    """

    centre: NDArray[np.float64]
    width: float
    depth: float
    height: float
    yaw: float


def add_building(
    builder: MeshBuilder, plan: Footprint, style: FacadeStyle, *, roof: str, lively: float, rng: np.random.Generator
) -> None:
    """Add a building: a glass core behind a relief of wall pieces.

    Every gap of the relief is a window.

    Args:
        builder: receives the triangles.
        plan: position and size.
        style: dimensions of the façade.
        roof: ``flat``, ``hip``, or anything else for a gabled roof.
        lively: probability that a side has balconies. The probability of awnings grows with it too.
        rng: random generator.
    """
    wall = PLASTERS[rng.integers(len(PLASTERS))] * rng.uniform(0.8, 1.15) + rng.normal(0, 0.02, 3)
    wall = np.clip(wall, 0.05, 0.92)
    material = Material.BRICK if rng.random() < 0.4 else Material.MATTE
    sunk = 2.0  # metres below the ground: no gap opens on a slope
    base = plan.centre - [0.0, 0.0, sunk]
    builder.box(base, (plan.width, plan.depth, plan.height + sunk), plan.yaw, GLASS, Material.GLASS)
    for side in range(4):
        along, away = (plan.width, plan.depth) if side % 2 == 0 else (plan.depth, plan.width)
        _facade(builder, plan, style, side, along, away, wall, material, lively, rng)
    top = plan.centre + [0.0, 0.0, plan.height]
    if roof == "flat":
        builder.box(top, (plan.width + 0.3, plan.depth + 0.3, 0.35), plan.yaw, wall * 0.7, Material.MATTE)
        if rng.random() < 0.5:
            builder.box(
                top, (plan.width * 0.5, plan.depth * 0.5, rng.uniform(1.5, 4)), plan.yaw, wall * 0.6, Material.MATTE
            )
        for _ in range(int(rng.integers(0, 4))):  # chimneys and ventilation
            offset = rng.uniform(-0.4, 0.4, 2) * (plan.width, plan.depth)
            builder.box(
                top + [*_turned(offset, plan.yaw), 0.3],
                (0.8, 0.8, rng.uniform(0.6, 1.8)),
                plan.yaw,
                wall * 0.5,
                Material.MATTE,
            )
    else:
        _pitched_roof(builder, plan, hipped=roof == "hip", rng=rng)


def _turned(offset: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]])


def _facade(
    builder: MeshBuilder,
    plan: Footprint,
    style: FacadeStyle,
    side: int,
    along: float,
    away: float,
    wall: NDArray[np.float64],
    material: Material,
    lively: float,
    rng: np.random.Generator,
) -> None:
    """Add the piers and spandrels of one side, a door, and perhaps balconies, awnings, steps, a rain pipe or a bay window."""
    yaw = plan.yaw + side * np.pi / 2
    out = np.array([np.sin(yaw), -np.cos(yaw)])
    tangent = np.array([np.cos(yaw), np.sin(yaw)])
    ground = plan.centre[2]

    def at(u: float, beyond: float, z: float) -> NDArray[np.float64]:
        xy = plan.centre[:2] + out * (away / 2 + beyond) + tangent * u
        return np.array([xy[0], xy[1], z])

    storeys = max(1, int(plan.height / style.storey))
    bays = max(1, int(along / style.bay))
    step = along / bays
    pier = max(0.25, step - style.window_width)
    for k in range(bays + 1):
        width = pier if 0 < k < bays else pier / 2
        u = float(np.clip(-along / 2 + k * step, -along / 2 + width / 2, along / 2 - width / 2))
        builder.box(
            at(u, style.relief / 2, ground - 2.0), (width, style.relief, plan.height + 2.0), yaw, wall, material
        )
    spandrel = max(0.3, style.storey - style.window_height)
    for storey in range(storeys + 1):
        low = ground - 2.0 if storey == 0 else ground + storey * style.storey - (spandrel - style.sill)
        high = ground + style.sill if storey == 0 else low + spandrel
        high = min(high, ground + plan.height)
        if storey == storeys:
            high = ground + plan.height
        if high - low > 0.05:
            builder.box(
                at(0.0, style.relief * 0.49, low), (along, style.relief * 0.98, high - low), yaw, wall * 0.96, material
            )
    if rng.random() < lively:
        depth = rng.uniform(0.7, 1.4)
        for storey in range(1, storeys):
            for k in range(bays):
                if rng.random() < 0.4:
                    u = -along / 2 + (k + 0.5) * step
                    z = ground + storey * style.storey - 0.1
                    builder.box(
                        at(u, style.relief + depth / 2, z), (step * 0.85, depth, 1.1), yaw, wall * 0.85, Material.METAL
                    )
    door = float(rng.uniform(-along / 2 + 1, along / 2 - 1)) if along > 3 else 0.0
    door_colour = rng.uniform(0.08, 0.5, 3)
    builder.box(at(door, style.relief * 0.2, ground), (1.1, style.relief * 0.4, 2.1), yaw, door_colour, Material.MATTE)
    builder.box(at(door, 0.6, ground + 2.3), (rng.uniform(1.2, 2.5), 1.2, 0.2), yaw, wall * 0.8, Material.MATTE)
    if rng.random() < 0.4:
        builder.box(
            at(door, 0.6, ground - 0.5),
            (rng.uniform(1.5, 3), 1.2, 0.5 + rng.uniform(0.2, 0.6)),
            yaw,
            np.array([0.5, 0.5, 0.48]),
            Material.MATTE,
        )
    if rng.random() < 0.35 * lively * 2 and along > 6:
        colour = AWNINGS[rng.integers(len(AWNINGS))]
        for _ in range(int(rng.integers(1, 4))):
            u = float(rng.uniform(-along / 2 + 1.5, along / 2 - 1.5))
            builder.box(
                at(u, 0.8, ground + rng.uniform(2.5, 3.0)), (rng.uniform(2, 4), 1.6, 0.25), yaw, colour, Material.MATTE
            )
    if rng.random() < 0.5:  # a rain pipe or a bay window
        u = float(rng.uniform(-along / 2 + 0.3, along / 2 - 0.3))
        if along > 6 and rng.random() < 0.4 and storeys > 1:
            z = ground + rng.uniform(0, style.storey)
            builder.box(
                at(u * 0.6, 0.5, z), (rng.uniform(1.5, 3), 1.0, plan.height - (z - ground)), yaw, wall * 1.03, material
            )
        else:
            builder.box(at(u, style.relief + 0.06, ground), (0.12, 0.12, plan.height), yaw, wall * 0.4, Material.METAL)


def _pitched_roof(builder: MeshBuilder, plan: Footprint, *, hipped: bool, rng: np.random.Generator) -> None:
    rise, overhang = rng.uniform(1.5, 3.8), 0.45
    x, y = plan.width / 2 + overhang, plan.depth / 2 + overhang
    if rng.random() < 0.6:  # the ridge is parallel to the street
        inset = x * 0.45 if hipped else 0.0
        corners = np.array(
            [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], [-x + inset, 0, rise], [x - inset, 0, rise]]
        )
        faces = np.array([[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [3, 0, 4], [1, 2, 5]])
    else:
        inset = y * 0.45 if hipped else 0.0
        corners = np.array(
            [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], [0, -y + inset, rise], [0, y - inset, rise]]
        )
        faces = np.array([[1, 2, 5], [1, 5, 4], [3, 0, 4], [3, 4, 5], [0, 1, 4], [2, 3, 5]])
    c, s = np.cos(plan.yaw), np.sin(plan.yaw)
    turned = corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + plan.centre + [0, 0, plan.height]
    builder.triangles(turned[faces], ROOFS[rng.integers(len(ROOFS))] * rng.uniform(0.8, 1.2), Material.MATTE)
    if rng.random() < 0.6:
        at = plan.centre[:2] + _turned(rng.uniform(-0.3, 0.3, 2) * (plan.width, plan.depth), plan.yaw)
        builder.box(
            np.array([*at, plan.centre[2] + plan.height]),
            (0.7, 0.7, rise + rng.uniform(0.3, 1)),
            plan.yaw,
            np.array([0.45, 0.28, 0.22]),
            Material.BRICK,
        )
