"""Skinned body meshes at several levels of detail, assembled from lofts and fitted to a family."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.ground.mesh import smooth_normals
from physics.people.accessories import Cap, Carried, Hair, carried, hair, headgear
from physics.people.ambient import unshaded
from physics.people.arms import arms
from physics.people.clips import bind_of
from physics.people.companions import companion_pieces, reach
from physics.people.families import Family, man_rest_m, skeleton
from physics.people.figure import (
    LEVELS,
    MESH_LEVELS,
    RIBBON_RINGS,
    RIBBONS,
    Build,
    Companion,
    Legs,
    Sleeve,
    legs,
    torso_pieces,
)
from physics.people.head import about_head, neck_and_head
from physics.people.lofted_mesh import Piece, lofted, tube
from physics.people.skeleton import Skeleton, model_pose

COATS: Final = (
    *("skin", "lips", "hair", "white", "dark", "top", "bottom", "shoes", "bag", "cap"),
    *("trim", "metal", "fur"),
)
"""Surfaces of a body; a person has one colour for each."""


@dataclass(frozen=True, slots=True)
class Outfit:
    """Components of a body: family, build, clothes, hair, carried and pushed objects."""

    family: Family
    build: Build
    legs: Legs
    sleeve: Sleeve
    hair: Hair
    cap: Cap = ""
    carried: Carried = ""
    bare: bool = False
    loose_m: float = 0.0
    companion: Companion = ""


@dataclass(frozen=True, slots=True)
class SkinnedBody:
    """Skinned mesh in the A pose: x ahead, z up, soles at z = 0.

    vertices, normals: (V, 3)
    triangles: (T, 3), front counter-clockwise
    joints: (V, 4) uint8 rows
    weights: (V, 4) float32, descending, with sum 1
    coat: (V,) uint8 rows of COATS
    fat: (V,) float32, offset of a vertex on stouter people
    unshaded: (V,) float32, share of ambient light that the body leaves, 0 to 1
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    joints: NDArray[np.uint8]
    weights: NDArray[np.float32]
    coat: NDArray[np.uint8]
    fat: NDArray[np.float32]
    unshaded: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class FarBody:
    """Body of tubes whose rings turn towards the eye when drawn (`lofted_mesh.Tube`).

    middle, ahead, side: (V, 3)
    ring: (V, 4)
    still: (V,) true where rings are not turned
    ribbon: (V,) true where only an outline is drawn

    All other fields are as in SkinnedBody.
    """

    middle: NDArray[np.float32]
    ahead: NDArray[np.float32]
    side: NDArray[np.float32]
    ring: NDArray[np.float32]
    triangles: NDArray[np.int32]
    joints: NDArray[np.uint8]
    weights: NDArray[np.float32]
    coat: NDArray[np.uint8]
    fat: NDArray[np.float32]
    still: NDArray[np.bool_]
    ribbon: NDArray[np.bool_]
    unshaded: NDArray[np.float32]


@lru_cache(maxsize=256)
def body(outfit: Outfit, level: int) -> SkinnedBody:
    """Build the body at a mesh level of detail; 0 is full detail."""
    if not 0 <= level < MESH_LEVELS:
        raise ValueError(f"levels of meshes go from 0 to {MESH_LEVELS - 1}: {level}")
    surfaces = [
        (piece.coat, lofted(piece, level)) for piece in pieces(outfit) if piece.sides[level]
    ]
    starts = np.cumsum([0, *(len(s.vertices) for _, s in surfaces)])
    vertices = np.concatenate([s.vertices for _, s in surfaces])
    triangles = np.concatenate(
        [s.triangles + k for (_, s), k in zip(surfaces, starts.tolist(), strict=False)]
    )
    weights = np.concatenate([s.weights for _, s in surfaces])
    weights = _sided(vertices, weights)
    light = unshaded(vertices, smooth_normals(vertices, triangles))
    vertices = _fitted(vertices, weights, skeleton(outfit.family))
    joints, few = strongest(weights)
    coat = np.repeat(
        [COATS.index(coat) for coat, _ in surfaces], [len(s.vertices) for _, s in surfaces]
    )
    return SkinnedBody(
        vertices.astype(np.float32),
        smooth_normals(vertices, triangles).astype(np.float32),
        triangles.astype(np.int32),
        joints,
        few,
        coat.astype(np.uint8),
        np.concatenate([s.fat for _, s in surfaces]).astype(np.float32),
        light.astype(np.float32),
    )


@lru_cache(maxsize=256)
def far_body(outfit: Outfit, level: int) -> FarBody:
    """Build the body at a level of tubes or ribbons, MESH_LEVELS to LEVELS - 1."""
    if not MESH_LEVELS <= level < LEVELS:
        raise ValueError(f"levels of tubes go from {MESH_LEVELS} to {LEVELS - 1}: {level}")
    ribbon = level >= RIBBONS
    of = min(level, RIBBONS - 1)
    share = RIBBON_RINGS[level - RIBBONS] if ribbon else 1.0
    tubes = [
        (piece.coat, tube(piece, of, ribbon, share)) for piece in pieces(outfit) if piece.sides[of]
    ]
    starts = np.cumsum([0, *(len(t.middle) for _, t in tubes)])
    weights = np.concatenate(
        [_sided(t.corners, t.weights) if t.still else t.weights for _, t in tubes]
    )
    even = np.concatenate([t.weights for _, t in tubes])
    middle = np.concatenate([t.middle for _, t in tubes])
    family = skeleton(outfit.family)
    scale = family.height_m / 1.75
    joints, few = strongest(weights)
    counts = [len(t.middle) for _, t in tubes]
    coat = np.repeat([COATS.index(coat) for coat, _ in tubes], counts)
    return FarBody(
        _fitted(middle, even, family).astype(np.float32),
        (scale * np.concatenate([t.ahead for _, t in tubes])).astype(np.float32),
        (scale * np.concatenate([t.side for _, t in tubes])).astype(np.float32),
        np.concatenate([t.ring for _, t in tubes]).astype(np.float32),
        np.concatenate(
            [t.triangles + k for (_, t), k in zip(tubes, starts.tolist(), strict=False)]
        ).astype(np.int32),
        joints,
        few,
        coat.astype(np.uint8),
        np.concatenate([t.fat for _, t in tubes]).astype(np.float32),
        np.repeat([t.still for _, t in tubes], counts),
        np.repeat([t.ribbon for _, t in tubes], counts),
        unshaded(middle, np.zeros_like(middle)).astype(np.float32),
    )


@lru_cache(maxsize=128)
def pieces(outfit: Outfit) -> tuple[Piece, ...]:
    """Return the closed surfaces of a body."""
    build = outfit.build
    parts = torso_pieces(build, outfit.loose_m, outfit.legs)
    if outfit.legs == "skirt":
        parts = parts[:1]
    parts += neck_and_head(build)
    parts += legs(build, outfit.legs, outfit.bare, outfit.loose_m)
    holds = {side: reach(outfit.companion, side) for side in ("left", "right")}
    parts += arms(build, outfit.sleeve, outfit.loose_m, holds)
    parts += [about_head(piece, build.head) for piece in hair(outfit.hair)]
    if outfit.cap:
        parts += [about_head(piece, build.head) for piece in headgear(outfit.cap)]
    return (*parts, *carried(outfit.carried, outfit.loose_m), *companion_pieces(outfit.companion))


def strongest(weights: Floats) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the four joints with the largest weights of V vertices, and these weights.

    The weights are normalized to sum 1.
    """
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    few = np.take_along_axis(weights, order, axis=1)
    return order.astype(np.uint8), (few / few.sum(axis=1, keepdims=True)).astype(np.float32)


def _sided(vertices: Floats, weights: Floats) -> Floats:
    """Move weights of both hips or collars to the joint on the vertex's own side."""
    out = weights.copy()
    share = np.clip(0.5 + vertices[:, 1] / 0.10, 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    for a, b in ((1, 2), (13, 14)):
        both = np.minimum(weights[:, a], weights[:, b]) * 2.0
        middle = both > 0.0
        total = weights[:, a] + weights[:, b]
        out[:, a] = np.where(middle, total * share, weights[:, a])
        out[:, b] = np.where(middle, total * (1.0 - share), weights[:, b])
    return out


def _fitted(vertices: Floats, weights: Floats, family: Skeleton) -> Floats:
    """Move the man's vertices with their joints to the proportions and size of a family."""
    man = Skeleton(man_rest_m(), 1.75)
    scale = family.height_m / man.height_m
    _, ours = bind_of(Skeleton(family.rest_m / scale, man.height_m), model_pose())
    _, his = bind_of(man, model_pose())
    return (vertices + weights[:, : len(ours)] @ (ours - his)) * scale
