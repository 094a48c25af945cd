"""Tree models: a tapered trunk with branches, and a crown as one closed surface or as twigs.

The surface is the outer envelope of several spheres as seen from its centre. Hidden parts of the
spheres cost no triangles. Cameras with textures draw twigs on that surface around a dark core.
A twig is a card with the picture of a few dozen leaves, which is cut out between them.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from cosim.core.geometry import Floats
from physics.ground.mesh import Ints, Mesh, join, smooth_normals

_SIDES: Final = 13
"""Vertices around the crown."""

_ROWS: Final = 8
"""Rings between the poles of the crown; 2 * 13 * 8 = 208 triangles."""
_SHARPNESS: Final = 16.0
"""Exponent of the power mean that joins the clumps; larger values give deeper creases."""


_CORE: Final = 0.66
"""Size of the core behind the twigs, as a fraction of the crown."""
_TWIGS_WIDE: Final = 0.6, 0.15
"""Share of the radius of a closed crown, and share of the height, whose sum is the radius of twigs.

Detectors of people take small narrow crowns on thin trunks for people.
"""
Distance = Literal["near", "far"]
"""Distance at which a crown is drawn with its own number of twigs."""
TREE_TWIGS: Final[Mapping[Distance, tuple[int, float]]] = {"near": (80, 0.50), "far": (24, 0.76)}
"""Number of twigs of a crown, and their size as a fraction of the crown's radius."""
SHRUB_TWIGS: Final[Mapping[Distance, tuple[int, float]]] = {"near": (60, 0.42), "far": (16, 0.8)}
"""The same of a shrub."""
_TWIG_PICTURES: Final = 2
"""Pictures of twigs along each side of a layer of leaves."""


@dataclass(frozen=True, slots=True)
class Species:
    """Growth parameters of a tree species. The representation seeds the crown's shape.

    clear: height below the crown as a fraction of the total height
    wide: largest radius of the crown as a fraction of the height
    full: relative height of the widest part of the crown, 0 to 1
    clumps: number of spheres
    loose: radius of the spheres as a fraction of the crown's
    cover: layer of `physics.textures.walls` for the closed surface
    leaves: layer of twigs
    """

    clear: float
    wide: float
    full: float
    clumps: int
    loose: float
    cover: str
    leaves: str = field(repr=False)


SPECIES: Final = (
    Species(0.36, 0.245, 0.42, 9, 0.50, "foliage", "leaves"),
    Species(0.40, 0.215, 0.45, 8, 0.46, "foliage", "leaves-long"),
    Species(0.33, 0.165, 0.36, 8, 0.50, "foliage-dark", "leaves-small"),
    Species(0.42, 0.250, 0.55, 7, 0.55, "foliage", "leaves"),
)
"""A spreading tree, an oval tree, a narrow dark tree and an umbrella-shaped tree."""


@dataclass(frozen=True, slots=True)
class Crown:
    """Crown of a tree.

    mesh: closed surface, facing outwards
    shade: (V,) fraction of light that reaches each vertex
    """

    mesh: Mesh
    shade: Floats


def clear_height_m(species: Species, height_m: float) -> float:
    """Return the height in metres below the crown; people fit under it."""
    return max(species.clear * height_m, 2.15)


def crown(species: Species, height_m: float) -> Crown:
    """Return the crown of a tree with its foot at the origin."""
    low = clear_height_m(species, height_m)
    half = 0.5 * (height_m - low)
    wide = species.wide * height_m
    rng = np.random.default_rng(zlib.crc32(f"{species}:{height_m:.3f}".encode()))
    rays, triangles = _sphere()
    reach = _envelope(rays, species, rng) * rng.uniform(0.91, 1.09, len(rays))
    reach[[0, -1]] = (
        0.96 * reach[1 : 1 + _SIDES].mean(),
        0.96 * reach[-1 - _SIDES : -1].mean(),
    )  # avoids tips at the poles
    at = rays * reach[:, None]
    widest = np.hypot(at[:, 0], at[:, 1]).max()
    bottom, top = at[:, 2].min(), at[:, 2].max()
    up = (at[:, 2] - bottom) / (top - bottom)
    at[:, :2] *= wide / widest
    at[:, 2] = low + 2.0 * half * up
    near = np.maximum.reduceat(
        reach[_neighbours(triangles, len(rays))[0]], _neighbours(triangles, len(rays))[1]
    )
    crease = np.clip((reach / near - 0.66) / 0.34, 0.0, 1.0)
    shade = (0.50 + 0.50 * up**0.8) * (0.55 + 0.45 * crease)
    return Crown(Mesh(at, smooth_normals(at, triangles), triangles), shade)


@dataclass(frozen=True, slots=True)
class Twigs:
    """Cards around the core of a crown.

    mesh: cards with both sides; normals point away from the crown's middle
    shade: (V,) fraction of light that reaches each vertex
    spots: (V, 2) texture coordinates
    """

    mesh: Mesh
    shade: Floats
    spots: Floats


def leafy(species: Species, whole: Crown) -> Crown:
    """Return the wider crown over which the twigs of a species are spread."""
    share, more = _TWIGS_WIDE
    wider = max(share + more / species.wide, 1.0)
    at = whole.mesh.vertices * (wider, wider, 1.0)
    return Crown(Mesh(at, whole.mesh.normals, whole.mesh.triangles), whole.shade)


def crown_core(whole: Crown) -> Crown:
    """Return a smaller and darker crown that fills the gaps between twigs."""
    at = whole.mesh.vertices
    middle = 0.5 * (at.min(axis=0) + at.max(axis=0))
    inner = middle + _CORE * (at - middle)
    mesh = Mesh(inner, whole.mesh.normals, whole.mesh.triangles)
    return Crown(mesh, 0.42 * whole.shade)


def crown_twigs(whole: Crown, count: int, share: float) -> Twigs:
    """Return the twigs of a crown.

    share: size of a twig as a fraction of the crown's radius
    """
    at = whole.mesh.vertices
    low, high = at.min(axis=0), at.max(axis=0)
    middle = 0.5 * (low + high)
    rng = np.random.default_rng([len(at), count, zlib.crc32(np.round(at, 3).tobytes())])
    foot, out = _spread_over(whole.mesh, count, rng)
    depth = rng.uniform(0.62, 0.97, count) ** 0.7
    centre = middle + depth[:, None] * (foot - middle)
    half = 0.5 * share * 0.5 * float((high - low)[:2].mean()) * rng.uniform(0.8, 1.25, count)
    # Twigs lean out of the crown, turned about any axis, so that none is seen edge-on everywhere.
    facing = out + rng.normal(0.0, 0.75, (count, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    along = np.cross(facing, rng.normal(0.0, 1.0, (count, 3)))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(facing, along)
    corner = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    cards = centre[:, None] + half[:, None, None] * (
        corner[None, :, :1] * along[:, None] + corner[None, :, 1:] * across[:, None]
    )
    cards[..., 2] = np.clip(cards[..., 2], low[2], high[2])
    up = (cards[..., 2] - low[2]) / (high[2] - low[2])
    inner = np.linalg.norm(cards - middle, axis=2) / np.linalg.norm(foot - middle, axis=1)[:, None]
    shade = (0.48 + 0.52 * up) * (0.45 + 0.55 * np.clip((inner - 0.45) / 0.5, 0.0, 1.0))
    shade *= rng.uniform(0.78, 1.0, count)[:, None]
    picture = rng.integers(0, _TWIG_PICTURES, (count, 1, 2))
    spots = (picture + 0.5 + 0.49 * corner) / _TWIG_PICTURES
    normals = cards - middle + 0.3 * (high - low) * out[:, None]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    first = 4 * np.arange(count)[:, None]
    front = np.concatenate([first + np.array((0, 1, 2)), first + np.array((0, 2, 3))])
    triangles = np.concatenate([front, front[:, ::-1]]).astype(np.int32)
    mesh = Mesh(cards.reshape(-1, 3), normals.reshape(-1, 3), triangles)
    return Twigs(mesh, np.clip(shade, 0.0, 1.0).ravel(), spots.reshape(-1, 2))


def _spread_over(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return (N, 3) points spread evenly over a surface, and its normals there."""
    corners = mesh.vertices[mesh.triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    ends = np.cumsum(area)
    which = np.searchsorted(ends, (np.arange(count) + rng.random(count)) / count * ends[-1])
    which = np.minimum(which, len(area) - 1)
    share = rng.dirichlet((1.0, 1.0, 1.0), count)[:, :, None]
    normals = (share * mesh.normals[mesh.triangles[which]]).sum(axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (share * corners[which]).sum(axis=1), normals


def tree_trunk(species: Species, height_m: float, radius_m: float) -> Mesh:
    """Return a trunk that flares at its foot and ends inside the crown, with three branches."""
    low = clear_height_m(species, height_m)
    top = low + 0.30 * (height_m - low)
    heights = np.array([0.0, 0.35, 0.8 * low, top])
    radii = radius_m * np.array([1.0, 0.80, 0.62, 0.30])
    around = 2.0 * np.pi * np.arange(7) / 7
    lean = 0.02 * height_m * np.array([0.0, 0.0, 0.6, 1.0])
    middles = np.column_stack([lean, np.zeros(4), heights])
    tubes = [_tube(middles, radii, around)]
    fork = middles[2]
    for k in range(3):
        angle = 2.1 * k + 0.7
        tip = np.array([math.cos(angle), math.sin(angle), 0.0]) * 0.6 * species.wide * height_m
        tip[2] = low + (0.22 + 0.06 * k) * (height_m - low)
        start = fork + np.array([0.0, 0.0, 0.05 * k * low])
        tubes.append(
            _tube(np.stack([start, tip]), radius_m * np.array([0.36, 0.14]), around[[0, 2, 4]])
        )
    return join(tubes)


def _sphere() -> tuple[Floats, Ints]:
    """Return (V, 3) unit vectors of rings between two poles, and (T, 3) triangles.

    Every other ring is rotated by half a side.
    """
    polar = np.pi * np.arange(1, _ROWS + 1) / (_ROWS + 1)
    turn = (
        2.0 * np.pi * (np.arange(_SIDES)[None, :] + 0.5 * (np.arange(_ROWS)[:, None] % 2)) / _SIDES
    )
    ring = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.cos(polar)[:, None] + 0 * turn,
        ],
        axis=-1,
    )
    rays = np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
    k = np.arange(_SIDES)
    after = (k + 1) % _SIDES
    found = [np.stack([np.zeros_like(k), 1 + k, 1 + after], axis=1)]
    for row in range(_ROWS - 1):
        a = 1 + row * _SIDES
        b = 1 + (row + 1) * _SIDES
        if row % 2 == 0:
            found += [
                np.stack([a + k, b + k, a + after], 1),
                np.stack([a + after, b + k, b + after], 1),
            ]
        else:
            found += [
                np.stack([a + k, b + k, b + after], 1),
                np.stack([a + k, b + after, a + after], 1),
            ]
    last = 1 + (_ROWS - 1) * _SIDES
    found.append(np.stack([last + k, np.full_like(k, len(rays) - 1), last + after], axis=1))
    return rays, np.concatenate(found).astype(np.int32)


def _envelope(rays: Floats, species: Species, rng: np.random.Generator) -> Floats:
    """Return (V,) the relative radius of the envelope in each direction, about 1."""
    golden = np.pi * (3.0 - math.sqrt(5.0))
    n = species.clumps
    up = np.linspace(-0.55, 0.95, n) + rng.uniform(-0.08, 0.08, n)
    around = golden * np.arange(n) + rng.uniform(-0.4, 0.4, n)
    flat = np.sqrt(
        np.maximum(1.0 - np.clip((up - 2.0 * species.full + 1.0) / 1.2, -1.0, 1.0) ** 2, 0.05)
    )
    middle = (1.0 - 0.8 * species.loose) * np.column_stack(
        [flat * np.cos(around), flat * np.sin(around), up]
    )
    radius = species.loose * rng.uniform(0.85, 1.15, n)
    middle = np.concatenate([np.zeros((1, 3)), middle])
    radius = np.append(0.5, radius)
    along = rays @ middle.T
    inside = radius**2 - (middle**2).sum(axis=1) + along**2
    far = np.where(inside > 0.0, along + np.sqrt(np.maximum(inside, 0.0)), 0.0)
    reach = (np.maximum(far, 0.0) ** _SHARPNESS).sum(axis=1) ** (1.0 / _SHARPNESS)
    return np.asarray(reach)


def _neighbours(triangles: Ints, count: int) -> tuple[Ints, Ints]:
    """Return the neighbours of each vertex.

    Returns: the lists of all vertices (own index and neighbours) joined together, and each list's
        start
    """
    pairs = np.concatenate([triangles[:, [i, j]] for i in range(3) for j in range(3)])
    pairs = np.unique(pairs, axis=0)
    return pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(count)).astype(np.int32)


def _tube(middles: Floats, radii: Floats, around: Floats) -> Mesh:
    """Return a tube through (N, 3) points with (N,) radii, open at both ends, with level rings."""
    circle = np.column_stack([np.cos(around), np.sin(around), np.zeros(len(around))])
    at = (middles[:, None] + radii[:, None, None] * circle).reshape(-1, 3)
    k = np.arange(len(around))
    after = (k + 1) % len(k)
    found = []
    for row in range(len(middles) - 1):
        a = row * len(k)
        b = (row + 1) * len(k)
        found += [
            np.stack([a + k, a + after, b + after], 1),
            np.stack([a + k, b + after, b + k], 1),
        ]
    triangles = np.concatenate(found).astype(np.int32)
    return Mesh(at, smooth_normals(at, triangles), triangles)
