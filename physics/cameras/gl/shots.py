"""Views of the pictures of a batch as arrays, to cull moving objects of all pictures at once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.gl.shading import anchor_of, camera_matrices
from physics.cameras.view import VISIBLE_M, Shot

STEP_M: Final = 8.0
"""Spacing of the lattice of shadow box middles, metres."""
CELL_M: Final = 2.0
"""Side of a cell of eyes: what is visible from a scene is decided for a whole cell, metres."""


def middle_of(eye_m: Floats) -> Floats:
    """Return the (..., 3) middles of the spaces with shadows around eyes, world metres."""
    return np.asarray(np.round(eye_m / STEP_M) * STEP_M)


class Lattice(NamedTuple):
    """Where an eye is on the lattices of cells, anchors and shadow boxes."""

    cell: tuple[int, int]
    anchor: tuple[float, ...]
    middle: tuple[float, ...]


class Shots:
    """N views.

    taken: the views themselves
    lattice: of each
    anchor, middle: (N, 2) and (N, 3) world metres, as from `anchor_of` and `middle_of`
    eye: (N, 3)

    In all methods, `whose` (M,) is the view of each of (M, 2) points.
    """

    def __init__(self, taken: Sequence[Shot]) -> None:
        self.taken = taken
        self.eye = np.array([one.eye_m for one in taken])
        self.anchor, self.middle = anchor_of(self.eye), middle_of(self.eye)
        cells = np.round(self.eye[:, :2] / CELL_M).astype(np.int64)
        rows = zip(cells.tolist(), self.anchor.tolist(), self.middle.tolist(), strict=True)
        self.lattice = [Lattice((i, j), tuple(at), tuple(middle)) for (i, j), at, middle in rows]
        self._half = np.array([one.half_picture for one in taken])
        self._axes = np.array([one.axes for one in taken])
        self._pixel = 2.0 * self._half[:, 1] / [one.size[1] for one in taken]
        columns = []
        for one, (x, y, _), (_, tall) in zip(
            taken, self.eye.tolist(), self._half.tolist(), strict=True
        ):
            view = one.view
            heading, half = view.heading_rad, view.half_angle_rad
            wedge = (
                math.cos(heading),
                math.sin(heading),
                math.cos(half),
                math.sin(half),
                view.behind_m,
            )
            columns.append((x, y, *wedge, 1.75 * 0.5 * one.size[1] / tall))
        self._columns = np.array(columns).T
        self._alone = columns[0] if len(columns) == 1 else None

    def cameras(self) -> Floats:
        """Return the (N, 4, 4) matrices of `camera_matrix`."""
        eye = self.eye.copy()
        eye[:, :2] -= self.anchor
        return camera_matrices(self._axes, eye, self._half)

    def views(self) -> Floats:
        """Return the (N, 5, 4) rows of `SceneBlocks.set`."""
        rows = np.zeros((len(self.eye), 5, 4))
        rows[:, 0, :3] = self.eye
        rows[:, 0, :2] -= self.anchor
        rows[:, 1, :2] = self.anchor
        rows[:, 2:, :3] = self._axes
        rows[:, 2:4, 3] = self._half
        rows[:, 4, 3] = self._pixel
        return rows

    def sees(self, whose: NDArray[np.intp], xy: Floats, margin_m: float) -> NDArray[np.bool_]:
        """Return the (M,) mask of `View.sees` for each point in its view."""
        x, y, cos, sin, cos_half, sin_half, behind = self._of(whose, 0, 7)
        dx, dy = xy[:, 0] - x, xy[:, 1] - y
        ahead = dx * cos + dy * sin
        aside = np.abs(dy * cos - dx * sin)
        inner = ahead + behind
        near = dx * dx + dy * dy < VISIBLE_M * VISIBLE_M
        return np.asarray(
            (aside * cos_half - inner * sin_half < margin_m) & (inner > -margin_m) & near
        )

    def far_m(self, whose: NDArray[np.intp], xy: Floats) -> Floats:
        """Return (M,) horizontal distances of points from the eyes."""
        x, y = self._of(whose, 0, 2)
        return np.asarray(np.hypot(xy[:, 0] - x, xy[:, 1] - y))

    def tall_px(self, whose: NDArray[np.intp], far_m: Floats, z_m: Floats) -> Floats:
        """Return (M,) heights of people in the pictures, in pixels.

        far_m: (M,) horizontal distances from the eyes
        z_m: (M,) ground heights
        """
        (px,) = self._of(whose, 7, 8)
        dz = z_m + 0.9 - self.eye[whose, 2]
        return np.asarray(px / np.maximum(np.hypot(far_m, dz), 0.1))

    def _of(
        self, whose: NDArray[np.intp], first: int, end: int
    ) -> Iterable[Floats] | Iterable[float]:
        """Return parameters of each point's view as columns; for a single view, as scalars."""
        if self._alone is None:
            return self._columns[first:end, whose]
        return self._alone[first:end]
