"""Lofts: smooth closed surfaces through rings, at any level of detail, with joint weights.

A loft is defined by a few key rings.
Finer levels interpolate rings on smooth curves; coarser levels omit the least important keys.
A ring with few sides is enlarged to match the mean width of the round ring over all directions.
Silhouettes therefore agree between levels of detail.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.people.skeleton import INDEX

Joints = Mapping[str, float]
"""Weights of joints, by name; they sum to 1."""
GROUND: Final = "ground"
"""Joint after those of the skeleton, which moves with the place and heading of the body alone."""
ROWS: Final[Mapping[str, int]] = MappingProxyType({**INDEX, GROUND: len(INDEX)})
"""Row of each joint of a loft."""


@dataclass(frozen=True, slots=True)
class Ring:
    """Cross-section of a loft.

    at: centre
    ahead, side: half axes, metres; the angle runs from ahead to side
    back: half axis opposite to `ahead`, as a fraction of it
    square: exponent; 2 is an ellipse, larger values approach a box
    """

    at: tuple[float, float, float]
    ahead: tuple[float, float, float]
    side: tuple[float, float, float]
    joints: Joints
    back: float = 1.0
    square: float = 2.0
    fat: float = 0.0


@dataclass(frozen=True, slots=True)
class Piece:
    """Closed surface.

    rings: from one end to the other
    coat: surface that selects the colour
    sides: per level; 0 omits the piece
    rings_kept: number of rings per level, more or fewer than the keys
    """

    coat: str
    rings: tuple[Ring, ...]
    sides: tuple[int, ...]
    rings_kept: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class LoftedPiece:
    """Piece at one level of detail.

    vertices: (V, 3), metres
    triangles: (T, 3), front counter-clockwise
    weights: (V, 25), in the order of ROWS
    fat: (V,)
    """

    vertices: Floats
    triangles: NDArray[np.int32]
    weights: Floats
    fat: Floats


def lofted(piece: Piece, level: int) -> LoftedPiece:
    """Build a piece at a level of detail, closed by a fan at both ends."""
    table = _chosen(_table(piece.rings), piece.rings_kept[level])
    sides = piece.sides[level]
    boxy = sides % 8 == 0 and float(table[:, 10].mean()) > 2.8
    corners = 0.0 if boxy or sides % 2 else 0.5
    angle = 2.0 * np.pi * (np.arange(sides) + corners) / sides
    rings = _points(table, angle)
    grow = _perimeters(_points(table, _ROUND)) / np.maximum(_perimeters(rings), 1e-9)
    rings = table[:, None, :3] + grow[:, None, None] * (rings - table[:, None, :3])
    vertices = np.concatenate([rings.reshape(-1, 3), table[[0, -1], :3]])
    triangles = _sheet(len(table), sides)
    if _volume(vertices, triangles) < 0.0:
        triangles = triangles[:, ::-1].copy()
    own = np.concatenate([np.repeat(table[:, 12:], sides, axis=0), table[[0, -1], 12:]])
    return LoftedPiece(vertices, triangles, _shares(own), own[:, _JOINTS])


@dataclass(frozen=True, slots=True)
class Tube:
    """Piece whose rings a renderer turns towards the eye.

    The first and last corner of each ring lie on its outline, the others in front of it.
    The hidden back has no corners, so few corners draw the outline of the round ring.

    middle, ahead, side: (V, 3) of the corner's ring
    ring: (V, 4) back, square, cosine and sine of the angle from the outline to the corner
    triangles: (T, 3)
    weights: (V, 25), in the order of ROWS
    fat: (V,)
    still: corners are not turned, run all around, and have angles from `ahead`
    ribbon: only the outline is drawn
    """

    middle: Floats
    ahead: Floats
    side: Floats
    ring: Floats
    triangles: NDArray[np.int32]
    weights: Floats
    fat: Floats
    still: bool
    ribbon: bool

    @property
    def corners(self) -> Floats:
        """Approximate positions of the corners without turning, (V, 3)."""
        return np.asarray(
            self.middle + self.ring[:, 2:3] * self.ahead + self.ring[:, 3:4] * self.side
        )


def tube(piece: Piece, level: int, ribbon: bool = False, share: float = 1.0) -> Tube:
    """Build a piece at a coarse level with an even number of sides.

    ribbon: draw the piece as a ribbon if it is upright
    share: fraction of the level's rings to use; three rings or fewer remain

    A piece that follows both legs spreads sideways, which turned rings cannot show.
    Its corners are not turned, and it has more of them.
    """
    kept = piece.rings_kept[level]
    kept = max(min(kept, 3), math.ceil(share * kept))
    table = _chosen(_table(piece.rings), kept)
    sides = piece.sides[level]
    spreads = bool(
        (
            np.minimum(table[:, 12 + INDEX["left_hip"]], table[:, 12 + INDEX["right_hip"]]) > 0.15
        ).any()
    )
    if spreads:
        sides = 6 if ribbon else max(2 * sides, 10)
        table[:, 3:9] *= np.pi / (sides * np.sin(np.pi / sides))
    angle = 2.0 * np.pi * (np.arange(sides) + 0.5 * spreads) / sides
    solid = np.concatenate([_points(table, angle).reshape(-1, 3), table[[0, -1], :3]])
    triangles = _sheet(len(table), sides)
    outward = _volume(solid, triangles) > 0.0
    way = np.abs(table[-1, :3] - table[0, :3])
    ribbon = (
        ribbon and not spreads and bool(way[2] > way[0])
    )  # a ribbon is invisible when viewed edge-on
    if not spreads:
        angle = np.array([0.0, np.pi]) if ribbon else angle[: sides // 2 + 1]
        triangles = _sheet(len(table), len(angle), open_=True, capped=not ribbon)
    poles = table[:0] if ribbon else table[[0, -1]]
    poles[:, 3:9] *= 1e-3
    rows = np.concatenate([np.repeat(table, len(angle), axis=0), poles])
    corner = np.concatenate([np.tile(angle, len(table)), np.zeros(len(poles))])
    ring = np.column_stack([rows[:, 9:11], np.cos(corner), np.sin(corner)])
    triangles = triangles if outward else triangles[:, ::-1].copy()
    return Tube(
        rows[:, :3],
        rows[:, 3:6],
        rows[:, 6:9],
        ring,
        triangles,
        _shares(rows[:, 12:]),
        rows[:, 12 + _JOINTS],
        spreads,
        ribbon,
    )


@lru_cache(maxsize=256)
def _sheet(rings: int, sides: int, open_: bool = False, capped: bool = True) -> NDArray[np.int32]:
    """Return (T, 3) triangles between successive rings, and to the two poles after them.

    Open rings have no side from the last vertex to the first.
    """
    n, k = rings, sides
    around = np.arange(k)[: k - open_]
    after = ((np.arange(k) + 1) % k)[: k - open_]
    base = k * np.arange(n - 1)[:, None]
    quads = [
        base + around,
        base + after,
        base + k + after,
        base + around,
        base + k + after,
        base + k + around,
    ]
    sheet = np.moveaxis(np.stack(quads), 0, -1).reshape(-1, 3)
    low = np.stack([np.full(len(around), n * k), after, around], 1)
    high = np.stack([np.full(len(around), n * k + 1), (n - 1) * k + around, (n - 1) * k + after], 1)
    whole = np.concatenate([sheet, low, high] if capped else [sheet]).astype(np.int32)
    whole.flags.writeable = False
    return whole


def _shares(rows: Floats) -> Floats:
    weights = np.maximum(rows[:, :_JOINTS], 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def scaled_vector(vector: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    """Return a vector times a factor."""
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


def ball(
    coat: str,
    at: tuple[float, float, float],
    half: tuple[float, float, float],
    joints: Joints,
    sides: Sequence[int],
) -> Piece:
    """Return an ellipsoid with (x, y, z) half axes."""
    rings = []
    for share in (-0.97, -0.72, -0.28, 0.28, 0.72, 0.97):
        wide = float(np.sqrt(1.0 - share * share))
        place = (at[0], at[1], at[2] + half[2] * share)
        rings.append(Ring(place, (half[0] * wide, 0.0, 0.0), (0.0, half[1] * wide, 0.0), joints))
    return Piece(
        coat, tuple(rings), tuple(sides), tuple(min(max(s, 4), 6) if s > 5 else 4 for s in sides)
    )


_JOINTS: Final = len(ROWS)
_WIDTH: Final = 12 + _JOINTS + 1
_ROUND: Final = 2.0 * np.pi * np.arange(64) / 64


def _table(rings: Sequence[Ring]) -> Floats:
    """Return the rings as (K, 38): middle, ahead, side, back, square, spare, 25 weights, fat."""
    table = np.zeros((len(rings), _WIDTH))
    for row, ring in zip(table, rings, strict=True):
        row[:9] = (*ring.at, *ring.ahead, *ring.side)
        row[9], row[10], row[12 + _JOINTS] = ring.back, ring.square, ring.fat
        for name, weight in ring.joints.items():
            row[12 + ROWS[name]] = weight
    return table


def _chosen(table: Floats, wanted: int) -> Floats:
    """Resample the keys to the wanted number of rings.

    More rings are interpolated on smooth curves. For fewer rings, the keys of least effect are
    removed.
    Results are cached, because outfits share many pieces.
    """
    return _kept(table.tobytes(), wanted).copy()


@lru_cache(maxsize=2048)
def _kept(rows: bytes, wanted: int) -> Floats:
    table = np.frombuffer(rows).reshape(-1, _WIDTH)
    if wanted > len(table):
        return _between(table, wanted)
    kept = list(range(len(table)))
    losses: dict[tuple[int, int, int], float] = {}
    while len(kept) > max(wanted, 2):
        for ends in zip(kept, kept[1:], kept[2:], strict=False):
            if ends not in losses:
                losses[ends] = _loss(table, *ends)
        cost = [losses[ends] for ends in zip(kept, kept[1:], kept[2:], strict=False)]
        del kept[1 + cost.index(min(cost))]
    return _fitted(table, kept)


def _fitted(table: Floats, kept: list[int]) -> Floats:
    """Fit the remaining rings to the finer shape by least squares.

    Straight segments between them then run through that shape, not inside it. Both ends stay fixed.
    """
    fine = _between(table, 5 * len(table))
    way = np.concatenate([[0.0], np.cumsum(_gaps(fine))])
    at = way[[int(np.argmin(np.abs(fine[:, :9] - table[k, :9]).sum(axis=1))) for k in kept]]
    hats = np.stack([np.interp(way, at, unit) for unit in np.eye(len(kept))], axis=1)
    length = np.sqrt(np.gradient(way))[:, None]
    rings = table[kept].copy()
    rest = fine[:, :10] - hats[:, [0, -1]] @ rings[[0, -1], :10]
    rings[1:-1, :10] = np.linalg.lstsq(length * hats[:, 1:-1], length * rest, rcond=None)[0]
    return rings


def _loss(table: Floats, before: int, middle: int, after: int) -> float:
    """Return the surface displacement caused by omitting the middle ring."""
    way = np.linalg.norm(np.diff(table[[before, middle, after], :3], axis=0), axis=1)
    share = way[0] / max(way.sum(), 1e-9)
    line = table[before, :9] * (1.0 - share) + table[after, :9] * share
    return float(np.abs(line - table[middle, :9]).sum() * way.sum())


def _between(table: Floats, wanted: int) -> Floats:
    """Return `wanted` rings: the keys, plus points of a smooth curve in the longest gaps."""
    way = np.concatenate([[0.0], np.cumsum(_gaps(table))])
    gaps = np.diff(way).tolist()
    extra = [0] * len(gaps)
    shares = list(gaps)
    for _ in range(wanted - len(table)):
        longest = shares.index(max(shares))
        extra[longest] += 1
        shares[longest] = gaps[longest] / (extra[longest] + 1)
    tangent = np.gradient(table, way, axis=0)
    rows = []
    for i, more in enumerate(extra):
        t = (np.arange(more + 1) / (more + 1))[:, None]
        width = way[i + 1] - way[i]
        low = table[i]
        high = table[i + 1]
        inner = (1 + 2 * t) * (1 - t) ** 2 * low + t**2 * (3 - 2 * t) * high
        inner += width * (t * (1 - t) ** 2 * tangent[i] - t**2 * (1 - t) * tangent[i + 1])
        inner[:, 12:] = (1 - t) * low[12:] + t * high[12:]
        rows.append(inner)
    return np.concatenate([*rows, table[-1:]])


def _gaps(table: Floats) -> Floats:
    """Return (K-1,) distances between rings, in position and size."""
    step = np.diff(table[:, :9], axis=0)
    return np.asarray(np.sqrt((step**2).sum(axis=1)) + 1e-6)


def _points(table: Floats, angle: Floats) -> Floats:
    """Return (K, A, 3) points on the rings."""
    cos, sin = np.cos(angle), np.sin(angle)
    power = (2.0 / table[:, 10])[:, None]
    x = np.sign(cos) * np.abs(cos) ** power * np.where(cos < 0.0, table[:, 9:10], 1.0)
    y = np.sign(sin) * np.abs(sin) ** power
    return np.asarray(
        table[:, None, :3] + x[..., None] * table[:, None, 3:6] + y[..., None] * table[:, None, 6:9]
    )


def _perimeters(points: Floats) -> Floats:
    """Return (K,) perimeters of (K, A, 3) rings.

    The mean width of a convex ring is its perimeter over pi (Cauchy).
    """
    return np.asarray(np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2).sum(axis=1))


def _volume(vertices: Floats, triangles: NDArray[np.int32]) -> float:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)))
