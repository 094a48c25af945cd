"""Draw the answers of a policy in each scene into its pictures and into a view from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from cosim.core.errors import PolicyError
from cosim.core.geometry import Floats
from cosim.episode.interfaces import Observation
from cosim.report.hud import shade, words
from cosim.report.legend import Image
from cosim.spec.camera import Calibration
from scenarios.tools.policy_check.drives import SCENES, SceneName
from scenarios.tools.policy_check.edits import IN_MIRROR, Edit
from scenarios.tools.policy_check.query import Answered, PolicyQuery

_WIDE_PX: Final = 480
_BAR_PX: Final = 26
_ABOVE_PX: Final = 110
_ABOVE_M: Final = (6.0, 3.0)
"""Extent of the view from above: ahead and to either side, in metres."""
_ARC_S: Final = 2.0
_WAY: Final = (255, 210, 40)
_FOLLOWED: Final = (255, 70, 60)
_MOST: Final = 64


def check_sheet(query: PolicyQuery) -> Image:
    """Draw a row for each scene, as it is and in a mirror, (H, W, 3) uint8 RGB."""
    rows = []
    for scene in SCENES:
        seen = query.drives[scene].seen
        row = [(seen, scene, ()), (IN_MIRROR.change(seen), f"{scene}, in a mirror", (IN_MIRROR,))]
        rows.append(
            np.hstack([_panel(query, scene, shown[-1], name, edits) for shown, name, edits in row])
        )
    return np.vstack(rows)


def path_of(answer: Answered) -> Floats:
    """Return the waypoints, or the path of the command within 2 s, (N, 2) metres ahead and left."""
    if answer.waypoints is not None:
        return answer.waypoints[:_MOST, :2]
    headings = answer.turn_rad * np.linspace(0.0, _ARC_S, 11)
    steps = (
        max(answer.v_mps, 0.0)
        * _ARC_S
        / 10
        * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    )
    return np.cumsum(steps[:-1], axis=0)


def _panel(
    query: PolicyQuery, scene: SceneName, seen: Observation, name: str, edits: Sequence[Edit]
) -> Image:
    answer = None
    try:
        answer = query.answer(scene, *edits)
        label = f"{name}: {answer.v_mps:.2f} m/s, {answer.degrees}"
        path = path_of(answer)
    except PolicyError as error:
        label = f"{name}: {error}"
        path = np.zeros((0, 2))
    index = query.manifest.waypoints.index
    followed = (
        index if answer is not None and answer.waypoints is not None and index < len(path) else None
    )
    if seen.rgb is None or seen.camera is None:
        picture = np.full((_ABOVE_PX + 2 * _BAR_PX, _WIDE_PX, 3), 40, np.uint8)
    else:
        tall_px = round(_WIDE_PX * seen.rgb.shape[0] / seen.rgb.shape[1])
        picture = cv2.resize(seen.rgb, (_WIDE_PX, tall_px), interpolation=cv2.INTER_AREA)
        _draw(picture, pixels_of(path, seen.camera) * (_WIDE_PX / seen.rgb.shape[1]), followed)
    _draw_above(picture, path, followed)
    shade(picture, (0, 0, _WIDE_PX, _BAR_PX))
    words(picture, label, (8, 18), 0.45)
    picture[:, -2:] = 250
    picture[-2:] = 250
    return np.asarray(picture)


def pixels_of(path: Floats, camera: Calibration) -> Floats:
    """Return (M, 2) pixels of those of (N, 2) points on level ground, in metres, before a
    camera.
    """
    ground = np.column_stack([path, np.zeros(len(path)), np.ones(len(path))])
    points = (np.linalg.inv(camera.on_robot) @ ground.T).T[:, :3]
    points = np.where(points[:, 2:] > 0.05, points, np.nan)
    there = np.nan_to_num(points, nan=1.0)
    none = np.zeros(3)
    shown, _ = cv2.projectPoints(there, none, none, camera.matrix, camera.distortion)
    return np.where(np.isnan(points[:, :1]), np.nan, shown[:, 0])


def _draw(picture: Image, pixels: Floats, followed: int | None) -> None:
    high, wide = picture.shape[:2]
    last: tuple[int, int] | None = None
    for number, (x, y) in enumerate(pixels.tolist()):
        if not (math.isfinite(x) and abs(x) < 4 * wide and abs(y) < 4 * high):
            last = None
            continue
        at = round(x), round(y)
        if last is not None:
            cv2.line(picture, last, at, _WAY, 2, cv2.LINE_AA)
        radius, colour = (6, _FOLLOWED) if number == followed else (3, _WAY)
        cv2.circle(picture, at, radius, colour, -1, cv2.LINE_AA)
        last = at


def _draw_above(picture: Image, path: Floats, followed: int | None) -> None:
    """Draw a view from above in the upper right: a line for each metre, the robot in the lower
    middle.
    """
    x0 = _WIDE_PX - _ABOVE_PX - 4
    y0 = _BAR_PX + 4
    shade(picture, (x0, y0, x0 + _ABOVE_PX, y0 + _ABOVE_PX), 0.75)
    inset = picture[y0 : y0 + _ABOVE_PX, x0 : x0 + _ABOVE_PX]
    px_per_m = _ABOVE_PX / _ABOVE_M[0]
    for metre in range(1, int(_ABOVE_M[0])):
        inset[round(_ABOVE_PX - metre * px_per_m)] = 90
    xy = np.vstack([(0.0, 0.0), path])
    pixels = np.stack(
        [_ABOVE_PX / 2 - xy[:, 1] * px_per_m, _ABOVE_PX - 4 - xy[:, 0] * px_per_m], axis=1
    )
    copy = np.ascontiguousarray(inset)
    _draw(copy, pixels, None if followed is None else followed + 1)
    inset[:] = copy
