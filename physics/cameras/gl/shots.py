"""Views of the pictures of a batch as arrays, to cull moving objects of all pictures at once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from physics.cameras.gl.shading import anchor_of
from physics.cameras.gl.shadows import middle_of
from physics.cameras.view import VISIBLE_M, Shot


class Shots:
    """N views.

    taken: the views themselves
    anchors, middles: (2,) and (3,) world metres of each, as from `anchor_of` and `middle_of`
    anchor, middle: the same as (N, 2) and (N, 3) arrays
    eye: (N, 3)

    In all methods, `whose` (M,) is the view of each of (M, 2) points.
    """

    def __init__(self, taken: Sequence[Shot]) -> None:
        self.taken = taken
        self.anchors = [anchor_of(one.eye_m) for one in taken]
        self.middles = [middle_of(one.eye_m) for one in taken]
        self.anchor, self.middle = np.array(self.anchors), np.array(self.middles)
        self.eye = np.array([one.eye_m for one in taken])
        rows = []
        for one in taken:
            view = one.view
            tan = math.tan(0.5 * math.radians(one.fov_deg))
            heading, half = view.heading_rad, view.half_angle_rad
            wedge = (
                math.cos(heading),
                math.sin(heading),
                math.cos(half),
                math.sin(half),
                view.behind_m,
            )
            rows.append((*one.eye_m[:2].tolist(), *wedge, 1.75 * 0.5 * one.size[1] / tan))
        self._columns = np.array(rows).T
        self._alone = rows[0] if len(rows) == 1 else None

    def sees(self, whose: NDArray[np.intp], xy: Floats, margin_m: float) -> NDArray[np.bool_]:
        """Return the (M,) mask of `View.sees` for each point in its view."""
        x, y, cos, sin, cos_half, sin_half, behind, _ = self._of(whose)
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
        x, y, *_ = self._of(whose)
        return np.asarray(np.hypot(xy[:, 0] - x, xy[:, 1] - y))

    def tall_px(self, whose: NDArray[np.intp], xy: Floats, z_m: Floats) -> Floats:
        """Return (M,) heights of people in the pictures, in pixels.

        xy: (M, 2) positions
        z_m: (M,) ground heights
        """
        (*_, px) = self._of(whose)
        dz = z_m + 0.9 - self.eye[whose, 2]
        return np.asarray(px / np.maximum(np.hypot(self.far_m(whose, xy), dz), 0.1))

    def _of(self, whose: NDArray[np.intp]) -> Iterable[Floats] | Iterable[float]:
        """Return the parameters of each point's view as columns; for a single view, as scalars."""
        return self._columns[:, whose] if self._alone is None else self._alone
