"""Catalogue of street furniture and scenario obstacles, and the placed prop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.spec.obstacle import OBSTACLE_SIZES_M, OBSTACLE_VARIANTS, Obstacle, ObstacleKind
from physics.ground.mesh import Detail, Part, parts_seen
from physics.street import furniture_shapes as shapes
from physics.street import obstacle_shapes
from physics.street.furniture_shapes import METAL, WOOD, Size, Solid
from physics.textures.layers import Colour

Zone = Literal["verge", "curb", "frontage", "driveway"]
"""Zone of a sidewalk where a prop is placed.

verge: between curb and sidewalk
curb: edge of the sidewalk, where there is no verge
frontage: between sidewalk and buildings
driveway: frontage at the end of a driveway
"""

_Forms = tuple[
    Callable[[Size], tuple[Solid, ...]], Callable[..., tuple[Part, ...]], tuple[Colour, ...]
]
"""Functions for solids and parts, and the paints of an obstacle."""

PROP_VARIANTS: Final = OBSTACLE_VARIANTS
"""Sizes of each prop from smallest to largest; few, so that props share shapes."""

LEAVES: Final = ((0.22, 0.42, 0.17), (0.30, 0.48, 0.18), (0.18, 0.36, 0.22), (0.42, 0.46, 0.17))
"""sRGB colours of tree crowns."""

SIGNS: Final = ((0.12, 0.30, 0.66), (0.80, 0.12, 0.10), (0.95, 0.80, 0.12), (0.90, 0.90, 0.90))
HYDRANTS: Final = ((0.80, 0.13, 0.10), (0.90, 0.70, 0.10))
BINS: Final = ((0.16, 0.33, 0.22), (0.30, 0.31, 0.33), (0.16, 0.25, 0.42))
SCOOTERS: Final = ((0.20, 0.72, 0.36), (0.90, 0.42, 0.10), (0.12, 0.12, 0.13))
CARTONS: Final = ((0.68, 0.52, 0.34), (0.60, 0.45, 0.30), (0.36, 0.42, 0.50))
CHAIRS: Final = ((0.70, 0.20, 0.16), (0.22, 0.34, 0.50), (0.30, 0.42, 0.26), (0.60, 0.44, 0.28))
BIKES: Final = ((0.12, 0.24, 0.46), (0.62, 0.11, 0.12), (0.10, 0.10, 0.11), (0.20, 0.46, 0.36))
BOARDS: Final = ((0.08, 0.09, 0.10), (0.80, 0.12, 0.10), (0.12, 0.30, 0.66), (0.95, 0.80, 0.12))
FENCES: Final = ((0.88, 0.42, 0.08), (0.80, 0.12, 0.10))
CARS: Final = (
    (0.86, 0.86, 0.87),
    (0.12, 0.13, 0.15),
    (0.55, 0.57, 0.60),
    (0.62, 0.11, 0.12),
    (0.13, 0.24, 0.48),
)
ROOFS: Final = ((0.24, 0.26, 0.28), (0.16, 0.30, 0.28))
PLANTS: Final = ((0.30, 0.46, 0.20), (0.24, 0.40, 0.18), (0.55, 0.34, 0.40), (0.50, 0.50, 0.22))


@dataclass(frozen=True, slots=True)
class PropKind:
    """A catalogue entry.

    sizes_m: smallest and largest size of the solid part
    zones: zones where the prop may be placed
    per_100m: expected count per 100 m of sidewalk by street class
    solids, parts: functions of the size
    paints: sRGB colours to choose from
    row: place evenly spaced in a row
    spread_m: radius of parts above head height, which may overhang sidewalks but not buildings
    seen_m: drawing distance
    grown: the parts depend on the paint index
    """

    name: str
    sizes_m: tuple[Size, Size]
    zones: tuple[Zone, ...]
    per_100m: Mapping[str, float]
    solids: Callable[[Size], tuple[Solid, ...]]
    parts: Callable[..., tuple[Part, ...]]
    paints: tuple[Colour, ...]
    row: bool = False
    spread_m: float = 0.0
    seen_m: float = 30.0
    grown: bool = False

    def size_m(self, variant: int) -> Size:
        """Return length, depth and height of a variant."""
        low, high = np.array(self.sizes_m)
        length, depth, height = (low + (high - low) * variant / (PROP_VARIANTS - 1)).tolist()
        return length, depth, height


def _along(
    residential: float, commercial: float, avenue: float, boulevard: float, narrow: float
) -> dict[str, float]:
    """Return counts per 100 m of sidewalk by street class."""
    return {
        "residential": residential,
        "commercial": commercial,
        "avenue": avenue,
        "boulevard": boulevard,
        "ring": 0.5 * avenue,
        "narrow": narrow,
    }


CATALOGUE: Final[tuple[PropKind, ...]] = (
    PropKind(
        "shelter",
        ((2.8, 1.2, 2.3), (4.0, 1.5, 2.5)),
        ("verge", "frontage"),
        _along(0.0, 0.4, 0.7, 0.6, 0.0),
        shapes.three_walls,
        shapes.shelter,
        ROOFS,
        spread_m=0.2,
        seen_m=50.0,
    ),
    PropKind(
        "car",
        ((3.8, 1.7, 1.45), (4.6, 1.9, 1.45)),
        ("driveway",),
        _along(1.0, 0.4, 0.2, 0.2, 0.3),
        shapes.block,
        shapes.car,
        CARS,
        seen_m=50.0,
    ),
    PropKind(
        "tree",
        ((0.2, 0.2, 4.6), (0.4, 0.4, 7.5)),
        ("verge", "frontage"),
        _along(5.0, 2.5, 4.5, 7.0, 0.0),
        shapes.upright_solid,
        shapes.tree,
        LEAVES,
        row=True,
        spread_m=1.8,
        seen_m=50.0,
        grown=True,
    ),
    PropKind(
        "lamp",
        ((0.12, 0.12, 4.5), (0.16, 0.16, 7.0)),
        ("verge", "curb", "frontage"),
        _along(3.0, 4.0, 3.6, 3.6, 2.5),
        shapes.upright_solid,
        shapes.lamp,
        (METAL, (0.16, 0.24, 0.20), (0.45, 0.46, 0.47)),
        row=True,
        seen_m=50.0,
    ),
    PropKind(
        "fence",
        ((2.2, 0.4, 1.9), (4.0, 0.4, 2.1)),
        ("frontage",),
        _along(0.25, 0.35, 0.3, 0.2, 0.1),
        shapes.block,
        shapes.fence,
        FENCES,
        seen_m=40.0,
    ),
    PropKind(
        "cafe",
        ((1.75, 0.6, 0.85), (1.95, 0.75, 0.85)),
        ("frontage",),
        _along(0.1, 3.0, 1.0, 2.0, 0.3),
        shapes.table_and_chairs,
        shapes.cafe,
        CHAIRS,
    ),
    PropKind(
        "bench",
        ((1.4, 0.45, 0.85), (1.9, 0.55, 0.9)),
        ("verge", "frontage"),
        _along(0.8, 1.6, 1.2, 2.2, 0.1),
        shapes.block,
        shapes.park_bench,
        (WOOD, (0.40, 0.42, 0.40)),
    ),
    PropKind(
        "rack",
        ((0.75, 0.6, 0.8), (1.5, 0.75, 0.85)),
        ("verge", "frontage"),
        _along(0.4, 1.5, 0.7, 0.9, 0.1),
        shapes.hoops,
        shapes.rack,
        ((0.60, 0.62, 0.64), (0.20, 0.22, 0.24)),
    ),
    PropKind(
        "planter",
        ((0.7, 0.35, 0.8), (1.5, 0.5, 1.0)),
        ("frontage", "verge"),
        _along(1.5, 2.2, 0.8, 1.8, 1.2),
        shapes.block,
        shapes.planter,
        PLANTS,
    ),
    PropKind(
        "bin",
        ((0.42, 0.42, 0.9), (0.56, 0.56, 1.05)),
        ("verge", "frontage"),
        _along(1.2, 1.8, 1.0, 1.4, 0.4),
        shapes.upright_solid,
        shapes.litter_bin,
        BINS,
    ),
    PropKind(
        "scooter",
        ((1.15, 0.45, 1.1), (1.2, 0.5, 1.15)),
        ("verge", "frontage"),
        _along(0.5, 1.6, 0.8, 0.8, 0.3),
        shapes.block,
        shapes.scooter,
        SCOOTERS,
    ),
    PropKind(
        "boxes",
        ((0.7, 0.4, 0.6), (1.3, 0.6, 1.1)),
        ("frontage",),
        _along(0.5, 0.9, 0.4, 0.2, 0.5),
        shapes.block,
        shapes.boxes,
        CARTONS,
    ),
    PropKind(
        "hydrant",
        ((0.28, 0.28, 0.7), (0.32, 0.32, 0.8)),
        ("verge", "frontage"),
        _along(0.7, 0.6, 0.6, 0.6, 0.3),
        shapes.upright_solid,
        shapes.hydrant,
        HYDRANTS,
    ),
    PropKind(
        "sign",
        ((0.06, 0.06, 2.5), (0.08, 0.08, 2.8)),
        ("verge", "curb"),
        _along(1.6, 2.2, 2.0, 1.6, 1.6),
        shapes.upright_solid,
        shapes.sign,
        SIGNS,
        seen_m=40.0,
    ),
    PropKind(
        "bollard",
        ((0.12, 0.12, 0.75), (0.18, 0.18, 1.0)),
        ("verge", "curb"),
        _along(0.5, 2.0, 0.6, 1.0, 4.0),
        shapes.upright_solid,
        shapes.bollard,
        (METAL, (0.72, 0.60, 0.16)),
        row=True,
    ),
)
"""All street furniture, in order of placement: large props first."""

_OBSTACLES: Final[Mapping[ObstacleKind, _Forms]] = {
    "bin": (shapes.block, obstacle_shapes.wheeled_bin, ((0.12, 0.30, 0.20), *BINS)),
    "bike": (shapes.block, obstacle_shapes.bike, BIKES),
    "sign": (shapes.block, obstacle_shapes.sandwich_board, BOARDS),
    "planter": (shapes.block, shapes.planter, PLANTS),
    "box": (shapes.block, shapes.boxes, CARTONS),
    "fence": (shapes.block, obstacle_shapes.construction_fence, FENCES),
    "scooter": (shapes.block, shapes.scooter, SCOOTERS),
    "cafe": (shapes.table_and_chairs, shapes.cafe, CHAIRS),
}
"""Solids, parts and paints of scenario obstacles."""

KINDS: Final[Mapping[str, PropKind]] = {kind.name: kind for kind in CATALOGUE} | {
    f"obstacle:{name}": PropKind(
        f"obstacle:{name}", OBSTACLE_SIZES_M[name], (), {}, *forms, seen_m=math.inf
    )
    for name, forms in _OBSTACLES.items()
}
"""Every kind of prop by name, including scenario obstacles."""


@dataclass(frozen=True, slots=True)
class Prop:
    """A placed prop.

    kind: key in `KINDS`
    variant: index of the size
    heading_rad: direction of the prop's x axis
    paint: index in the kind's paints
    turned_rad: additional rotation of the drawn parts; solids are not rotated by it
    """

    id: str
    kind: str
    variant: int
    x_m: float
    y_m: float
    heading_rad: float
    paint: int
    turned_rad: float = 0.0

    @property
    def size_m(self) -> Size:
        """Length, depth and height."""
        return KINDS[self.kind].size_m(self.variant)

    @property
    def form(self) -> tuple[str, int, int]:
        """Arguments of `parts_of`; props with equal forms share meshes."""
        return self.kind, self.variant, self.paint if KINDS[self.kind].grown else 0

    @property
    def drawn_heading_rad(self) -> float:
        """Heading of the drawn parts."""
        return self.heading_rad + self.turned_rad


def obstacle_prop(obstacle: Obstacle, number: int) -> Prop:
    """Return a scenario obstacle as a prop; `number` is its index in the scenario."""
    kind = KINDS[f"obstacle:{obstacle.kind}"]
    paint = obstacle.paint % len(kind.paints)
    at = obstacle.x_m, obstacle.y_m, obstacle.heading_rad
    return Prop(f"obstacle:{number}:{obstacle.kind}", kind.name, obstacle.variant, *at, paint)


def footprints(props: Sequence[Prop]) -> NDArray[np.object_]:
    """Return the (N,) ground rectangles of props."""
    if not props:
        return np.zeros(0, dtype=object)
    half = 0.5 * np.array([prop.size_m[:2] for prop in props])
    heading = np.array([prop.heading_rad for prop in props])
    along = half[:, :1] * np.column_stack([np.cos(heading), np.sin(heading)])
    aside = half[:, 1:] * np.column_stack([-np.sin(heading), np.cos(heading)])
    middle = np.array([(prop.x_m, prop.y_m) for prop in props])
    corners = np.stack([-along - aside, along - aside, along + aside, aside - along], axis=1)
    return np.asarray(shapely.polygons(middle[:, None] + corners), dtype=object)


@cache
def parts_of(kind: str, variant: int, look: int = 0, detail: Detail = "plain") -> tuple[Part, ...]:
    """Return the drawn parts of a prop.

    look: paint index for kinds that are `grown`, else 0
    detail: camera and distance; "plain" is without textures
    """
    entry = KINDS[kind]
    size = entry.size_m(variant)
    return parts_seen(entry.parts(size, look) if entry.grown else entry.parts(size), detail)


@cache
def solids_of(kind: str, variant: int) -> tuple[Solid, ...]:
    """Return the collision shapes of a prop."""
    entry = KINDS[kind]
    return entry.solids(entry.size_m(variant))
