"""Project a way on the ground into the picture of the robot's camera."""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import numpy as np
import shapely

from cosim.core.geometry import Floats, Pose
from cosim.core.state import Command
from cosim.spec.camera import Lens
from physics.cameras.view import Shot

_LEADS_S: Final = 1.5
"""Duration for which the path of a command is drawn, in seconds."""
_NEAREST_M: Final = 0.05
_FARTHEST_M: Final = 100.0
"""Largest distance from the eye that is drawn, in metres."""
_PARTS: Final = 8
"""Number of parts of a stretch between two points. They follow the distortion of the lens and end
at the edge of the picture.
"""
_PLAIN_PX: Final = 0.3
_BESIDE: Final = 0.05
"""Margin beyond the picture, as a share of its width, within which lines are drawn, for their
thickness.
"""


class WayInPicture(NamedTuple):
    """A way in a picture.

    lines: pieces of the way, (M, 2) columns and rows from the upper left corner of the picture.
    points: (N, 2), NaN outside the picture.
    """

    lines: list[Floats]
    points: Floats


def way_in_picture(shot: Shot, lens: Lens, way: Floats) -> WayInPicture:
    """Project (N, 3) points of the world, and the line through them, into a picture of a lens."""
    wide, high = shot.size
    cuts = np.linspace(0.0, 1.0, _PARTS, endpoint=False)[:, None]
    line = np.concatenate([*(a + cuts * (b - a) for a, b in itertools.pairwise(way)), way[-1:]])
    at, points = _pixels(shot, lens, line), _pixels(shot, lens, way)
    breaks = np.flatnonzero(np.diff(np.isfinite(at[:, 0]))) + 1
    edge = _BESIDE * wide
    lines = []
    for piece in np.split(at, breaks):
        if len(piece) > 1 and np.isfinite(piece).all():
            inside = shapely.clip_by_rect(
                shapely.LineString(piece), -edge, -edge, wide + edge, high + edge
            )
            lines += [
                shapely.get_coordinates(one)
                for one in shapely.get_parts(shapely.simplify(inside, _PLAIN_PX))
            ]
    points[~((points >= 0.0) & (points <= (wide, high))).all(axis=1)] = np.nan
    return WayInPicture([one for one in lines if len(one)], points)


def _pixels(shot: Shot, lens: Lens, points: Floats) -> Floats:
    """Return (N, 2) columns and rows, NaN for invisible points.

    These are behind the eye, or where the projection of the lens folds over.
    """
    right, up, ahead = ((points - shot.eye_m) @ shot.axes.T).T
    seen = (ahead > _NEAREST_M) & (ahead < _FARTHEST_M)
    depth = np.where(seen, ahead, 1.0)
    offset = np.column_stack([right, -up]) / depth[:, None]
    r2 = (offset**2).sum(axis=1)
    seen &= 1.0 + 3.0 * lens.k1 * r2 + 5.0 * lens.k2 * r2**2 > 0.0
    bent = offset * (1.0 + lens.k1 * r2 + lens.k2 * r2**2)[:, None]
    focal_px = 0.5 * shot.size[1] / shot.half_picture[1]
    at = focal_px * bent + 0.5 * np.array(shot.size)
    return np.where(seen[:, None], at, np.nan)


def led_to(command: Command, pose: Pose, over_s: float = _LEADS_S) -> Floats:
    """Return the path of a command from a pose, (16, 2) metres in the world."""
    at_s = np.linspace(0.0, over_s, 16)
    turn = command.w_radps * at_s / 2.0
    along = command.v_mps * at_s
    along *= np.sinc(turn / np.pi)
    heading = pose.heading_rad + turn
    return pose.xy + np.column_stack([along * np.cos(heading), along * np.sin(heading)])
