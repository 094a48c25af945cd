"""Ground materials, and the random choice of a material for each street.

Both sidewalks of a street and its mid-block crossings share one material. Corners and junctions
keep the plain material, so that streets meet on neutral ground.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.place.open_ground import GROUND_LOOKS, PLAIN_GROUND
from cosim.place.street_map import Lane, StreetMap, Strip, street_of
from physics.textures.layers import Colour

PLAIN_FRICTION: Final = 0.9
"""Friction coefficient of ground without a material of its own, such as roads."""


@dataclass(frozen=True, slots=True)
class Material:
    """A ground material.

    name: key in `MATERIALS`
    friction: coefficient of friction against a tyre of 1.0
    colours: sRGB colours to choose from
    """

    name: str
    friction: float
    colours: tuple[Colour, ...]


MATERIALS: Final[Mapping[str, Material]] = {
    material.name: material
    for material in (
        Material("concrete", 0.90, ((0.66, 0.63, 0.58), (0.72, 0.71, 0.69), (0.60, 0.59, 0.57))),
        Material("pavers", 0.85, ((0.58, 0.55, 0.52), (0.69, 0.63, 0.52), (0.55, 0.57, 0.60))),
        Material("brick", 0.80, ((0.60, 0.38, 0.31), (0.66, 0.46, 0.36), (0.52, 0.36, 0.33))),
        Material("asphalt", 0.95, ((0.36, 0.36, 0.38), (0.42, 0.41, 0.41))),
        Material("grass", 0.70, ((0.35, 0.50, 0.24), (0.42, 0.50, 0.26), (0.30, 0.44, 0.22))),
    )
}
"""Every ground material by name."""

_SIDEWALKS: Final[Mapping[str, Mapping[str, float]]] = {
    "residential": {"concrete": 4, "pavers": 3, "asphalt": 2, "brick": 1},
    "commercial": {"concrete": 2, "pavers": 4, "brick": 3},
    "avenue": {"concrete": 5, "pavers": 3, "asphalt": 2},
    "boulevard": {"concrete": 2, "pavers": 5, "brick": 1},
    "narrow": {"brick": 4, "pavers": 4, "concrete": 1},
    "": {"concrete": 5, "pavers": 3, "asphalt": 2, "brick": 1},
}
"""Weight of each sidewalk material by street class; "" is the default class."""

_ROADS: Final[Mapping[str, Mapping[str, float]]] = {
    "narrow": {"": 3, "pavers": 3, "brick": 2},
    "": {"": 1},
}
"""Weight of each road material by street class; the material "" is plain asphalt."""

_VERGES: Final[Mapping[str, Mapping[str, float]]] = {"": {"grass": 1}}
"""Weight of each verge material by street class."""

_WEIGHTS: Final = {"sidewalk": _SIDEWALKS, "road": _ROADS, "verge": _VERGES}
"""Material weights for each kind of paved piece."""

_LANE_GAP_M: Final = 0.3
"""Largest distance in metres of a point to its lane; lanes leave gaps between them."""

_DEFAULT_MATERIALS: Final[Mapping[str, str]] = {"verge": "grass", "ground": "grass"}
"""Material of each kind of ground whose name has no material."""

PAVINGS: Final[Mapping[str, Colour]] = {
    f"{kind}:{name}:{i}": colour
    for kind, tables in _WEIGHTS.items()
    for name in dict.fromkeys(name for table in tables.values() for name in table if name)
    for i, colour in enumerate(MATERIALS[name].colours)
}
"""Colour of each paved surface by name: "kind:material:colour index"."""

APPEARANCE_OVERRIDES: Final[Mapping[str, tuple[str, Colour]]] = {
    "ground": ("ground", GROUND_LOOKS[PLAIN_GROUND].seen),
    "sidewalk:asphalt:0": ("sidewalk:footway:0", (0.57, 0.55, 0.52)),
    "sidewalk:asphalt:1": ("sidewalk:footway:1", (0.62, 0.60, 0.58)),
}
"""Texture and colour that replace a surface's own on every map except generated cities.

Walkable ground must not resemble a carriageway or open ground, so the asphalt of a footway is
light.
"""


def friction(surface: str) -> float:
    """Return the friction coefficient of a surface name."""
    kind, _, rest = surface.partition(":")
    name = rest.partition(":")[0] if rest else _DEFAULT_MATERIALS.get(kind, "")
    return MATERIALS[name].friction if name else PLAIN_FRICTION


class Paving:
    """Assignment of materials to the streets of a map."""

    def __init__(self, street_map: StreetMap, seed: int) -> None:
        self._map = street_map
        self._seed = seed

    def surface(self, piece: Strip | Lane) -> str:
        """Return the surface name of a sidewalk, road or verge.

        Plain pieces have their kind alone as name.
        """
        edge = piece.edge if isinstance(piece, Lane) else piece.id
        strip = self._map.strips.get(edge)
        tables = _WEIGHTS[piece.kind]
        table = tables.get(strip.street_class if strip is not None else "", tables[""])
        rng = np.random.default_rng(
            [self._seed, zlib.crc32(street_of(edge).encode()), zlib.crc32(piece.kind.encode())]
        )
        shares = np.cumsum(list(table.values()))
        name = list(table)[int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))]
        return (
            f"{piece.kind}:{name}:{rng.integers(len(MATERIALS[name].colours))}"
            if name
            else piece.kind
        )

    def pieces(self, area: shapely.Geometry) -> list[Strip | Lane]:
        """Return the sidewalks and lanes that touch an area."""
        strips = [
            s
            for s in self._map.near("strip", area)
            if isinstance(s, Strip) and s.kind == "sidewalk"
        ]
        lanes = [
            lane
            for lane in self._map.near("lane", area)
            if isinstance(lane, Lane) and not lane.internal
        ]
        return [*strips, *lanes]

    def surface_names(
        self,
        kinds: Sequence[str],
        points: Floats,
        pieces: Sequence[Strip | Lane],
        area: shapely.Geometry,
    ) -> list[str]:
        """Return surface names for points whose kind of ground is known.

        kinds: kind of ground at each point
        points: (N, 2) m
        pieces: result of `pieces` for the area
        area: area that contains the points
        """
        names = np.asarray(kinds, dtype=object)
        located = np.asarray(shapely.points(points), dtype=object)
        in_corner = np.zeros(len(names), dtype=bool)
        corners = [corner.polygon for corner in self._map.near("corner", area)]
        if corners:
            in_corner[shapely.STRtree(corners).query(located, predicate="intersects")[0]] = True
        for kind in _WEIGHTS:
            candidates = [piece for piece in pieces if piece.kind == kind]
            rows = np.flatnonzero((names == kind) & ~in_corner)
            if candidates and len(rows):
                tree = shapely.STRtree([piece.polygon for piece in candidates])
                # Lanes of a road have gaps between them, so the nearest lane is used.
                row, piece = tree.query_nearest(
                    located[rows], max_distance=_LANE_GAP_M, all_matches=False
                )
                names[rows[row]] = [self.surface(candidates[k]) for k in piece.tolist()]
        return list(names)


def end_lines(pieces: Sequence[Strip | Lane]) -> NDArray[np.object_]:
    """Return lines across both ends of each piece.

    The ground is divided along them, so that each piece can have its own surface.
    """
    if not pieces:
        return np.zeros(0, dtype=object)
    ends = np.array([(p.line[i, :2], p.line[j, :2]) for p in pieces for i, j in ((0, 1), (-1, -2))])
    along = ends[:, 1] - ends[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    half = np.repeat([0.5 * p.width_m + _LANE_GAP_M for p in pieces], 2)[:, None]
    offset = half * along[:, ::-1] * (-1.0, 1.0)
    return np.asarray(
        shapely.linestrings(np.stack([ends[:, 0] - offset, ends[:, 0] + offset], axis=1)),
        dtype=object,
    )
