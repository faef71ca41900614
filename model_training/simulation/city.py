"""A city that follows from its seed: streets, terrain, buildings, gardens and trees, and the occupants of each traversal."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model_training.simulation.buildings import FacadeStyle, Footprint, add_building
from model_training.simulation.districts import DISTRICTS, DOWNTOWN, MIXED_SHARES, RESIDENTIAL, WOODED, District
from model_training.simulation.meshes import Material, Mesh, MeshBuilder
from model_training.simulation.street_life import add_bush, add_furniture, add_person, add_tree, add_vehicle
from model_training.simulation.streets import Street, paper_streets, random_streets, streets_geojson
from model_training.simulation.terrain import GroundPicture, Terrain

Vector = NDArray[np.float64]
#: Distances of a car park's rows from the pavement, and the width of a slot, metres.
CAR_ROWS_M, CAR_SLOT_M = (4.0, 15.0, 20.5), 2.8


class City:
    """The static objects of a city, and the slots where vehicles and people may stand.

    Args:
        seed: the same seed gives the same city.
        name: ``paper`` for the paper's city, ``mixed`` for one with all kinds of districts. Any other name gives a random city of the
            first three kinds.
        size_m: extent of a random city in x and y, metres.

    Attributes:
        seed: seed of the city.
        name: name of the city.
        streets: street network.
        half_size_m: half the extent in x and y, metres.
        terrain: ground height.
        ground: cover of the ground.
        static: mesh of all static objects, map frame.
    """

    def __init__(self, *, seed: int, name: str = "city", size_m: tuple[float, float] = (300.0, 400.0)) -> None:
        rng = np.random.default_rng([7919, seed, name == "paper"])
        self.seed, self.name = seed, name
        self.streets: list[Street] = paper_streets(rng) if name == "paper" else random_streets(rng, size_m)
        points = np.concatenate([line for street in self.streets for line in street.lines])
        self.half_size_m = (float(np.abs(points[:, 0]).max()) + 20, float(np.abs(points[:, 1]).max()) + 20)
        self.terrain = Terrain.random(rng)
        self.ground = GroundPicture.of(self.streets, self.half_size_m)
        self._centre = points
        self._half = np.concatenate([np.full(len(line), s.half_width_m) for s in self.streets for line in s.lines])
        self._tree = cKDTree(points)
        self._district_seeds, self._district_kinds = self._districts(rng)
        self._occupied: list[NDArray[np.float64]] = []
        self._parking: list[tuple[float, float, float, float]] = []  # x and y (m), yaw (rad), probability of a car
        self._walks: list[tuple[float, float, float, float]] = []  # x and y (m), yaw (rad), probability of a person
        builder = MeshBuilder()
        self.terrain.add_to(builder, self.half_size_m)
        lines = [(street, line) for street in self.streets for line in street.lines]
        for k in rng.permutation(len(lines)):
            street, line = lines[k]
            self._line_up(builder, street, line, rng)
        self._background(builder, rng)
        self.static: Mesh = builder.mesh()

    def streets_geojson(self) -> dict[str, Any]:
        """Return the street classes as GeoJSON polygons, map frame, metres."""
        return streets_geojson(self.streets)

    def height(self, x: float, y: float) -> float:
        """Return the ground height at a point, metres.

        Args:
            x: map frame, metres.
            y: map frame, metres.
        """
        return float(self.terrain.height(np.array([x, y])))

    def district_of(self, point: Vector) -> int:
        """Return the index in ``DISTRICTS`` of the district nearest to a point.

        Args:
            point: position (2,), map frame, metres.
        """
        nearest = int(np.argmin(((self._district_seeds - point) ** 2).sum(axis=1)))
        return int(self._district_kinds[nearest])

    def occupants(self, traversal: int, *, parked_changed: float = 0.5) -> Mesh:
        """Return the mesh of the vehicles and people of one traversal.

        A share of the parked cars is the same in every traversal. People and moving vehicles differ between traversals.

        Args:
            traversal: number of the traversal; 0 is the survey.
            parked_changed: share of the parking slots whose cars are drawn anew for the traversal. It has no effect on the survey.
        """
        builder = MeshBuilder()
        for k, (x, y, yaw, share) in enumerate(self._parking):
            keeper = np.random.default_rng([self.seed, 11, k])
            stays = keeper.random() >= parked_changed or traversal == 0
            rng = keeper if stays else np.random.default_rng([self.seed, 12, traversal, k])
            if rng.random() < share:
                base = np.array([x, y, self.height(x, y)]) + [*rng.normal(0, 0.15, 2), 0.0]
                add_vehicle(builder, base, yaw + rng.normal(0, 0.03) + (np.pi if rng.random() < 0.3 else 0.0), rng)
        rng = np.random.default_rng([self.seed, 13, traversal])
        for x, y, yaw, share in self._walks:
            if rng.random() < share:
                offset = rng.normal(0, 0.6, 2)
                base = np.array([x + offset[0], y + offset[1], self.height(x, y)])
                add_person(builder, base, yaw + rng.uniform(-np.pi, np.pi), rng)
        for street in self.streets:  # sparse oncoming traffic
            for line in street.lines:
                for k in range(4, len(line) - 4):
                    if rng.random() < 0.012:
                        along = line[k + 1] - line[k]
                        side = np.array([-along[1], along[0]]) / np.linalg.norm(along)
                        at = line[k] + side * (0.5 * street.half_width_m)
                        base = np.array([at[0], at[1], self.height(*at)])
                        add_vehicle(builder, base, float(np.arctan2(-along[1], -along[0])), rng)
        return builder.mesh()

    def clearance(self, points: Vector) -> float:
        """Return the smallest distance of points to any carriageway, metres; negative on a carriageway.

        Args:
            points: positions (n, 2), map frame, metres.
        """
        distance, index = self._tree.query(points, k=min(6, len(self._centre)))
        return float((distance - self._half[index]).min())

    def _districts(self, rng: np.random.Generator) -> tuple[Vector, NDArray[np.int64]]:
        if self.name == "paper":
            seeds = np.array([[-80, -110], [60, -120], [-60, 20], [70, 40], [-80, 140], [70, 150]], float)
            return seeds, np.array([DOWNTOWN, DOWNTOWN, RESIDENTIAL, RESIDENTIAL, RESIDENTIAL, WOODED])
        count = max(4, round(self.half_size_m[0] * self.half_size_m[1] / 5500.0))
        seeds = rng.uniform([-self.half_size_m[0], -self.half_size_m[1]], self.half_size_m, (count, 2))
        if self.name == "mixed":
            return seeds, rng.choice(len(DISTRICTS), count, p=MIXED_SHARES)
        return seeds, rng.choice([DOWNTOWN, DOWNTOWN, RESIDENTIAL, RESIDENTIAL, RESIDENTIAL, WOODED], count)

    def _free(self, corners: Vector, clearance_m: float) -> bool:
        around = np.concatenate([corners, (corners + np.roll(corners, 1, axis=0)) / 2, corners.mean(axis=0)[None]])
        if self.clearance(around) <= clearance_m:
            return False
        middle = corners.mean(axis=0)
        return not any(np.abs(other[0] - middle).max() < 60.0 and _overlap(corners, other) for other in self._occupied)

    def _line_up(self, builder: MeshBuilder, street: Street, line: Vector, rng: np.random.Generator) -> None:
        """Add the objects along both sides of one centre line."""
        travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
        length = float(travelled[-1])

        def at(u: float) -> tuple[Vector, Vector]:
            point, ahead, behind = (
                np.array([np.interp(t, travelled, line[:, 0]), np.interp(t, travelled, line[:, 1])])
                for t in (u, u + 1, u - 1)
            )
            direction = ahead - behind
            return point, direction / (np.linalg.norm(direction) + 1e-9)

        half, pavement = street.half_width_m, rng.uniform(1.5, 2.8)
        for side in (-1.0, 1.0):
            self._kerb(builder, line, side, half, pavement)
            self._houses(builder, at, length, side, half + pavement, rng)
            self._verge(builder, at, length, side, half, rng)

    def _kerb(self, builder: MeshBuilder, line: Vector, side: float, half: float, pavement: float) -> None:
        for k in range(len(line) - 1):
            middle, step = (line[k] + line[k + 1]) / 2, line[k + 1] - line[k]
            length = float(np.linalg.norm(step))
            normal = np.array([-step[1], step[0]]) / length * side
            centre = middle + normal * (half + pavement / 2)
            if self.clearance(centre[None]) > 0.8:
                # Each top corner is 13 cm above the ground at its own position, so the slab follows the slope.
                ends = [line[k], line[k + 1]]
                inner = [e + normal * half for e in ends]
                outer = [e + normal * (half + pavement) for e in ends]
                quad = np.array([[*p, self.height(*p) + 0.13] for p in (inner[0], inner[1], outer[1], outer[0])])
                foot = quad[:2] - [0, 0, 0.2]
                faces = np.array(
                    [
                        [quad[0], quad[1], quad[2]],
                        [quad[0], quad[2], quad[3]],
                        [foot[0], foot[1], quad[1]],
                        [foot[0], quad[1], quad[0]],
                    ]
                )
                builder.triangles(faces, np.array([0.36, 0.35, 0.33]), Material.GROUND)

    def _houses(
        self, builder: MeshBuilder, at: Any, length: float, side: float, edge: float, rng: np.random.Generator
    ) -> None:
        base_style, setback_share = FacadeStyle.random(rng), rng.random()
        u = rng.uniform(2, 8)
        while u < length - 4:
            district = DISTRICTS[self.district_of(at(u)[0])]
            width, depth = rng.uniform(*district.width), rng.uniform(*district.depth)
            height, setback = rng.uniform(*district.height), rng.uniform(*district.setback)
            if district.joined > 0.5:
                setback = setback_share * district.setback[1] * (1.0 if rng.random() < 0.75 else rng.uniform(0.2, 2.0))
            gap = 0.02 if rng.random() < district.joined else rng.uniform(*district.gap)
            point, direction = at(min(u + width / 2, length))
            normal = np.array([-direction[1], direction[0]]) * side
            yaw = float(np.arctan2(direction[1], direction[0])) + (0.0 if side > 0 else np.pi)
            yaw += 0.0 if district.joined > 0.5 else rng.normal(0, 0.06)
            built = district.built >= 1.0 or rng.random() < district.built
            for _ in range(3 if built else 0):
                centre = point + normal * (edge + setback + depth / 2)
                corners = _corners(centre, width, depth, yaw)
                if width > 4 and self._free(corners, 1.2):
                    self._occupied.append(corners)
                    ground = self.height(*centre)
                    style = base_style if rng.random() < 0.4 else FacadeStyle.random(rng)
                    plan = Footprint(np.array([*centre, ground]), width, depth, height, yaw)
                    roof = str(rng.choice(district.roofs))
                    add_building(
                        builder, plan, style, roof=roof, lively=0.45 if district.joined > 0.5 else 0.2, rng=rng
                    )
                    self._annex(builder, plan, rng)
                    break
                width, depth = 0.7 * width, 0.75 * depth
            if not built:
                self._car_park(point + normal * edge, direction, normal, width, district)
            if setback > 1.5 and rng.random() < 0.7:
                self._boundary(builder, point, direction, normal, edge, width + 0.8 * gap, district, rng)
            u += width + gap

    def _car_park(self, edge: Vector, direction: Vector, normal: Vector, width: float, district: District) -> None:
        """Add parking slots at right angles to the street, two rows per aisle."""
        yaw = float(np.arctan2(normal[1], normal[0]))
        for aside in CAR_ROWS_M:
            for along in np.arange(-width / 2, width / 2, CAR_SLOT_M):
                place = edge + normal * aside + direction * along
                corners = _corners(place, 5.0, 2.4, yaw)
                if self.clearance(place[None]) > 4.0 and self._free(corners, 3.0):
                    self._occupied.append(corners)
                    self._parking.append((place[0], place[1], yaw, district.parked))

    def _annex(self, builder: MeshBuilder, plan: Footprint, rng: np.random.Generator) -> None:
        if rng.random() > 0.35:
            return
        width, depth, height = rng.uniform(2.5, 5), rng.uniform(3, 6), rng.uniform(2.3, 3.5)
        tangent = np.array([np.cos(plan.yaw), np.sin(plan.yaw)]) * rng.choice([-1, 1])
        centre = plan.centre[:2] + tangent * (plan.width / 2 + width / 2 + 0.5)
        corners = _corners(centre, width, depth, plan.yaw)
        if self._free(corners, 1.5):
            self._occupied.append(corners)
            base = np.array([*centre, self.height(*centre) - 1.0])
            builder.box(base, (width, depth, height + 1.0), plan.yaw, rng.uniform(0.3, 0.75, 3), Material.MATTE)

    def _boundary(
        self,
        builder: MeshBuilder,
        point: Vector,
        direction: Vector,
        normal: Vector,
        edge: float,
        length: float,
        district: District,
        rng: np.random.Generator,
    ) -> None:
        """Add a fence, hedge or wall with a gate. Each piece stands at its own ground height."""
        kind = rng.choice(list(district.boundaries))
        height = {"fence": rng.uniform(0.8, 1.6), "hedge": rng.uniform(0.8, 1.9), "wall": rng.uniform(0.5, 1.8)}[
            str(kind)
        ]
        thick = {"fence": 0.08, "hedge": 0.7, "wall": 0.25}[str(kind)]
        colour = {
            "fence": np.array([0.3, 0.22, 0.15]),
            "hedge": np.array([0.1, 0.18, 0.06]),
            "wall": np.array([0.5, 0.46, 0.4]),
        }[str(kind)]
        material = {"fence": Material.MATTE, "hedge": Material.FOLIAGE, "wall": Material.BRICK}[str(kind)]
        yaw = float(np.arctan2(direction[1], direction[0]))
        gate = rng.uniform(-0.3, 0.3) * length
        step = 0.35 if kind == "fence" and rng.random() < 0.5 else 1.5  # separate pales with gaps, or closed boards
        for u in np.arange(-length / 2, length / 2, step):
            if abs(u - gate) < 1.3:
                continue
            centre = point + normal * (edge + 0.4) + direction * (u + step / 2)
            if self.clearance(centre[None]) > 1.2:
                width = 0.12 if step < 1 else step
                bumpy = height * (1.0 + (0.08 * rng.normal() if kind == "hedge" else 0.0))
                base = np.array([*centre, self.height(*centre) - 0.3])
                builder.box(base, (width, thick, bumpy + 0.3), yaw, colour * rng.uniform(0.9, 1.1), material)

    def _verge(
        self, builder: MeshBuilder, at: Any, length: float, side: float, half: float, rng: np.random.Generator
    ) -> None:
        """Add street trees, furniture, parking slots and places of pedestrians."""

        def spot(u: float, aside: float) -> tuple[Vector, float]:
            point, direction = at(u)
            normal = np.array([-direction[1], direction[0]]) * side
            return point + normal * (half + aside), float(np.arctan2(direction[1], direction[0]))

        district = DISTRICTS[self.district_of(at(length / 2)[0])]
        u = rng.uniform(3, 15)
        while u < length - 3:
            if rng.random() < district.tree_share:
                place, _ = spot(u, 0.9 + rng.uniform(0, 0.5))
                if self.clearance(place[None]) > 0.5:
                    add_tree(builder, np.array([*place, self.height(*place)]), rng)
            u += district.tree_step * rng.uniform(0.7, 1.4)
        u = rng.uniform(4, 16)
        while u < length - 3:
            place, yaw = spot(u, rng.uniform(0.4, 1.2))
            if self.clearance(place[None]) > 0.2:
                add_furniture(builder, np.array([*place, self.height(*place)]), yaw, rng)
            u += rng.uniform(9, 26)
        u = rng.uniform(8, 14)
        while u < length - 8:
            place, yaw = spot(u, -1.0)
            if half > 3.7 and self.clearance(place[None]) < 0.1 and self.clearance(spot(u, 2.5)[0][None]) > 1.0:
                self._parking.append((place[0], place[1], yaw, district.parked))
            u += rng.uniform(5.5, 7)
        for u in np.arange(5.0, length - 5.0, 5.0):
            place, yaw = spot(u + rng.uniform(-2, 2), rng.uniform(0.6, 2.0))
            if self.clearance(place[None]) > 0.3:
                self._walks.append((place[0], place[1], yaw, district.people / 20.0))

    def _background(self, builder: MeshBuilder, rng: np.random.Generator) -> None:
        """Add trees, bushes and back-yard fences away from the streets."""
        half = np.array(self.half_size_m)
        count = int(half[0] * half[1] * 4 / 45.0)
        for point in rng.uniform(-half - 25, half + 25, (count, 2)):
            share = DISTRICTS[self.district_of(point)].wild
            away = self.clearance(point[None])
            if 3 < away < 45 and rng.random() < share and self._free(_corners(point, 2.5, 2.5, 0.0), 3.0):
                base = np.array([*point, self.height(*point)])
                (add_bush if rng.random() < 0.25 else add_tree)(builder, base, rng)
        for _ in range(count // 22):
            point = rng.uniform(-half, half)
            if self.clearance(point[None]) > 8:
                base = np.array([*point, self.height(*point) - 1.0])
                size = (rng.uniform(5, 25), 0.15, 1.0 + rng.uniform(1, 2.2))
                builder.box(base, size, rng.uniform(0, np.pi), np.array([0.33, 0.25, 0.17]), Material.MATTE)


def _corners(centre: Vector, width: float, depth: float, yaw: float) -> Vector:
    c, s = np.cos(yaw), np.sin(yaw)
    local = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2]
    corners: Vector = local @ np.array([[c, s], [-s, c]]) + centre
    return corners


def _overlap(a: Vector, b: Vector) -> bool:
    """Test whether two rectangles (4, 2) overlap (separating axis theorem)."""
    for polygon in (a, b):
        for k in range(2):
            edge = polygon[k + 1] - polygon[k]
            normal = np.array([-edge[1], edge[0]])
            pa, pb = a @ normal, b @ normal
            if pa.max() <= pb.min() + 1e-6 or pb.max() <= pa.min() + 1e-6:
                return False
    return True
