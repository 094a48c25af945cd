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


class Boxes(NamedTuple):
    """N upright boxes.

    x, y: (N,) centres.
    cos, sin: (N,) of the headings.
    ahead, aside: (N,) half lengths and half widths.
    bottom, top: (N,) heights.
    """

    x: Floats
    y: Floats
    cos: Floats
    sin: Floats
    ahead: Floats
    aside: Floats
    bottom: Floats
    top: Floats


class Cylinders(NamedTuple):
    """N upright cylinders, columns as in `Boxes`."""

    x: Floats
    y: Floats
    radius: Floats
    bottom: Floats
    top: Floats


class Solids(NamedTuple):
    """Boxes and cylinders. Indices count the boxes first."""

    boxes: Boxes
    cylinders: Cylinders


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
    index: (N,) index of the solid, -1 without a hit.
    """

    distance: Floats
    index: NDArray[np.intp]


def boxes_of(rows: list[tuple[float, ...]]) -> Boxes:
    """Return boxes from rows of x, y, heading, length, width, bottom and top."""
    x, y, heading, length, width, bottom, top = np.array(rows, dtype=float).reshape(-1, 7).T
    return Boxes(x, y, np.cos(heading), np.sin(heading), 0.5 * length, 0.5 * width, bottom, top)


def cylinders_of(rows: list[tuple[float, ...]]) -> Cylinders:
    """Return cylinders from rows of x, y, radius, bottom and top."""
    return Cylinders(*np.array(rows, dtype=float).reshape(-1, 5).T)


def joined(parts: list[Solids]) -> Solids:
    """Return the solids of all parts; boxes and cylinders are each in the order of the parts."""
    return Solids(
        Boxes(*map(np.concatenate, zip(*[part.boxes for part in parts], strict=True))),
        Cylinders(*map(np.concatenate, zip(*[part.cylinders for part in parts], strict=True))),
    )


def within(solids: Solids, x_m: float, y_m: float, range_m: float) -> Solids:
    """Return the solids with a part within a horizontal distance of a point."""
    boxes, cylinders = solids
    far = np.hypot(boxes.x - x_m, boxes.y - y_m) - np.hypot(boxes.ahead, boxes.aside)
    near = far <= range_m
    off = np.hypot(cylinders.x - x_m, cylinders.y - y_m) - cylinders.radius
    here = off <= range_m
    return Solids(
        Boxes(*[column[near] for column in boxes]),
        Cylinders(*[column[here] for column in cylinders]),
    )


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
    solid = np.concatenate([first, second + len(boxes.x)])
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
    rays: Rays, boxes: Boxes, fan: _Fan
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return the hits of rays and boxes: (P,) rays, boxes and distances."""
    x0, y0, z0 = rays.origin
    cos, sin, ahead, aside = boxes.cos, boxes.sin, boxes.ahead, boxes.aside
    x, y = boxes.x - x0, boxes.y - y0
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
        (rays.z[ray], *_levels(boxes.bottom, boxes.top, z0, box)),
    ):
        enter, leave = _slab(component, middle, half)
        np.maximum(near, enter, out=near)
        np.minimum(far, leave, out=far)
    hit = (near <= far) & (near >= 0.0)
    return ray[hit], box[hit], near[hit]


def _cylinder_hits(
    rays: Rays, cylinders: Cylinders, fan: _Fan
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return the hits of rays and cylinders: (P,) rays, cylinders and distances."""
    x0, y0, z0 = rays.origin
    x, y, radius = cylinders.x - x0, cylinders.y - y0, cylinders.radius
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
    enter, leave = _slab(rays.z[ray], *_levels(cylinders.bottom, cylinders.top, z0, which))
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
