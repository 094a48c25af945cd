"""Upright boxes and cylinders as arrays, and the first of them on each ray."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats

_ANGLE_MARGIN_RAD: Final = 1e-9
"""Margin for rounding when rays are selected by their bearing."""

_TINY: Final = 1e-290
"""Replaces zero as a divisor."""

_CORNERS: Final = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])[:, :, None]


class Solids(NamedTuple):
    """Upright boxes and cylinders. Indices count the boxes first.

    boxes: (8, B) rows x, y of the centre, cosine and sine of the heading, half length, half width,
        bottom, top.
    cylinders: (5, C) rows x, y of the centre, radius, bottom, top.
    """

    boxes: Floats
    cylinders: Floats

    def __len__(self) -> int:
        return int(self.boxes.shape[1] + self.cylinders.shape[1])


class Rays(NamedTuple):
    """Rays from one origin.

    origin: x, y, z in metres.
    x, y, z: (N,) components of unit vectors.
    """

    origin: tuple[float, float, float]
    x: Floats
    y: Floats
    z: Floats


class Hits(NamedTuple):
    """First solid on each ray.

    distance: (N,) metres, inf without a hit.
    solid: (N,) index of the solid, -1 without a hit.
    """

    distance: Floats
    solid: NDArray[np.intp]


def boxes_of(rows: list[tuple[float, ...]]) -> Floats:
    """Return boxes from rows of x, y, heading, length, width, bottom and top."""
    x, y, heading, length, width, bottom, top = np.array(rows, dtype=float).reshape(-1, 7).T
    return np.stack(
        [x, y, np.cos(heading), np.sin(heading), 0.5 * length, 0.5 * width, bottom, top]
    )


def cylinders_of(rows: list[tuple[float, ...]]) -> Floats:
    """Return cylinders from rows of x, y, radius, bottom and top."""
    return np.array(rows, dtype=float).reshape(-1, 5).T


def joined(parts: list[Solids]) -> Solids:
    """Return the solids of all parts; boxes and cylinders are each in the order of the parts."""
    boxes, cylinders = zip(*parts, strict=True)
    return Solids(np.concatenate(boxes, axis=1), np.concatenate(cylinders, axis=1))


def within(solids: Solids, x_m: float, y_m: float, range_m: float) -> Solids:
    """Return the solids with a part within a horizontal distance of a point."""
    boxes, cylinders = solids
    far = np.hypot(boxes[0] - x_m, boxes[1] - y_m) - np.hypot(boxes[4], boxes[5])
    off = np.hypot(cylinders[0] - x_m, cylinders[1] - y_m) - cylinders[2]
    return Solids(boxes[:, far <= range_m], cylinders[:, off <= range_m])


def first_hits(rays: Rays, solids: Solids) -> Hits:
    """Return the first solid that each ray enters.

    A solid that contains the origin is not entered.
    """
    boxes, cylinders = solids
    count = len(rays.x)
    bearings = np.arctan2(rays.y, rays.x)
    order = np.argsort(bearings, kind="stable")
    fan = _Fan(np.concatenate([order, order]), bearings[order])
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        one, first, t_one = _box_hits(rays, boxes, fan)
        two, second, t_two = _cylinder_hits(rays, cylinders, fan)
    ray = np.concatenate([one, two])
    solid = np.concatenate([first, second + boxes.shape[1]])
    t = np.concatenate([t_one, t_two])
    distance = np.full(count, np.inf)
    np.minimum.at(distance, ray, t)
    index = np.full(count, -1, dtype=np.intp)
    nearest = t == distance[ray]
    index[ray[nearest]] = solid[nearest]
    return Hits(distance, index)


class _Fan:
    """Rays sorted by bearing."""

    def __init__(self, order: NDArray[np.intp], bearings: Floats) -> None:
        self._order = order
        self._bearings = np.concatenate([bearings, bearings + 2.0 * np.pi])

    def pairs(
        self, right: Floats, span: Floats, around: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return each ray and solid whose bearings meet, as two (P,) arrays of indices.

        right, span: (N,) first bearing of each solid, counter-clockwise, and its width.
        around: (N,) whether a solid is met by all bearings.
        """
        count = len(self._order) // 2
        right = right - 2.0 * np.pi * np.floor((right + np.pi) / (2.0 * np.pi))
        begin = np.searchsorted(self._bearings, right - _ANGLE_MARGIN_RAD, "left")
        end = np.searchsorted(self._bearings, right + span + _ANGLE_MARGIN_RAD, "right")
        begin[around] = 0
        size = np.minimum(end - begin, count)
        size[around] = count
        solid = np.repeat(np.arange(len(size)), size)
        shift = begin - (np.cumsum(size) - size)
        return self._order[np.arange(len(solid)) + shift[solid]], solid


def _box_hits(
    rays: Rays, boxes: Floats, fan: _Fan
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return the hits of rays and boxes: (P,) rays, boxes and distances."""
    x0, y0, z0 = rays.origin
    x, y, cos, sin, ahead, aside, bottom, top = boxes
    x, y = x - x0, y - y0
    u, v = x * cos + y * sin, y * cos - x * sin
    corner_u, corner_v = u + _CORNERS[:, 0] * ahead, v + _CORNERS[:, 1] * aside
    turn = np.arctan2(u * corner_v - v * corner_u, u * corner_u + v * corner_v)
    right = turn.min(axis=0)
    around = (np.abs(u) <= ahead) & (np.abs(v) <= aside)
    ray, box = fan.pairs(np.arctan2(y, x) + right, turn.max(axis=0) - right, around)
    cos, sin = cos[box], sin[box]
    along, across = rays.x[ray], rays.y[ray]
    near, far = _slab(along * cos + across * sin, u[box], ahead[box])
    for component, middle, half in (
        (across * cos - along * sin, v[box], aside[box]),
        (rays.z[ray], *_levels(bottom, top, z0, box)),
    ):
        enter, leave = _slab(component, middle, half)
        np.maximum(near, enter, out=near)
        np.minimum(far, leave, out=far)
    hit = (near <= far) & (near >= 0.0)
    return ray[hit], box[hit], near[hit]


def _cylinder_hits(
    rays: Rays, cylinders: Floats, fan: _Fan
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return the hits of rays and cylinders: (P,) rays, cylinders and distances."""
    x0, y0, z0 = rays.origin
    x, y, radius, bottom, top = cylinders
    x, y = x - x0, y - y0
    off = np.hypot(x, y)
    around = off <= radius
    half = np.arcsin(np.minimum(radius / np.maximum(off, _TINY), 1.0))
    ray, which = fan.pairs(np.arctan2(y, x) - half, 2.0 * half, around)
    along, across = rays.x[ray], rays.y[ray]
    x, y = x[which], y[which]
    a = np.maximum(along * along + across * across, _TINY)
    b = x * along + y * across
    miss = x * across - y * along
    root = np.sqrt(a * radius[which] ** 2 - miss * miss)
    near, far = (b - root) / a, (b + root) / a
    enter, leave = _slab(rays.z[ray], *_levels(bottom, top, z0, which))
    near, far = np.maximum(near, enter), np.minimum(far, leave)
    hit = (near <= far) & (near >= 0.0)
    return ray[hit], which[hit], near[hit]


def _levels(bottom: Floats, top: Floats, z_m: float, rows: NDArray[np.intp]) -> tuple[Floats, ...]:
    """Return middles above `z_m` and half heights of the solids in these rows."""
    return (0.5 * (bottom + top) - z_m)[rows], (0.5 * (top - bottom))[rows]


def _slab(component: Floats, middle: Floats, half: Floats) -> tuple[Floats, Floats]:
    """Return the distances at which rays enter and leave slabs around their middles."""
    inverse = 1.0 / (component + _TINY * (component == 0.0))
    centre, reach = middle * inverse, half * np.abs(inverse)
    return centre - reach, centre + reach
