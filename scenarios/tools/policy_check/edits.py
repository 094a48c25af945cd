"""Edits of a drive before a policy is queried: mirrored, or with other colours, goals or
pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.clock import Clock
from cosim.core.state import write_protect
from cosim.episode.interfaces import Observation
from cosim.spec.camera import Calibration, CameraPicture, flipped
from cosim.spec.goal import Goal
from cosim.spec.sensors import clear_scan

_MIRROR: Final = np.diag([1.0, -1.0, 1.0, 1.0])
"""Transformation that exchanges left and right in the frame of the robot."""
_MIRROR_PX: Final = np.diag([-1.0, 1.0, 1.0, 1.0])
"""Transformation that exchanges left and right in the frame of a camera."""
Observations = Sequence[Observation]


class Edit(NamedTuple):
    """Change of a drive, with a unique name."""

    name: str
    change: Callable[[Observations], list[Observation]]


def of_each(name: str, change: Callable[[Observation], Observation]) -> Edit:
    """Return an edit that changes each observation separately."""
    return Edit(name, lambda seen: [change(one) for one in seen])


def in_mirror(seen: Observation) -> Observation:
    """Mirror an observation: left and right are exchanged."""
    odometry = seen.odometry
    if odometry is not None:
        heading = None if odometry.heading_rad is None else -odometry.heading_rad
        odometry = msgspec.structs.replace(odometry, y_m=-odometry.y_m, heading_rad=heading)
    return replace(
        seen,
        rgb=_flipped(seen.rgb),
        depth=_flipped(seen.depth),
        labels=_flipped(seen.labels),
        w_radps=-seen.w_radps,
        goal=None if seen.goal is None else seen.goal.mirrored(),
        odometry=odometry,
        scan=None if seen.scan is None else seen.scan.mirrored(),
        imu=None if seen.imu is None else seen.imu.mirrored(),
        people=None if seen.people is None else seen.people.mirrored(),
        camera=None
        if seen.camera is None or seen.rgb is None
        else _camera_in_mirror(seen.camera, seen.rgb.shape[1]),
        pictures={
            name: CameraPicture(
                flipped(one.rgb),
                _flipped(one.labels),
                _flipped(one.depth),
                _camera_in_mirror(one.camera, one.rgb.shape[1]),
            )
            for name, one in seen.pictures.items()
        },
    )


def with_goal(name: str, goal: Goal | None) -> Edit:
    """Return an edit that replaces the goal of all observations."""
    return of_each(f"goal {name}", lambda seen: replace(seen, goal=goal))


def with_pictures(name: str, paint: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Edit:
    """Return an edit that repaints all pictures, including that of the goal."""

    def painted(seen: Observation) -> Observation:
        goal = None if seen.goal is None else seen.goal.painted(paint)
        pictures = {key: replace(one, rgb=paint(one.rgb)) for key, one in seen.pictures.items()}
        return replace(
            seen, rgb=None if seen.rgb is None else paint(seen.rgb), goal=goal, pictures=pictures
        )

    return of_each(name, painted)


IN_MIRROR: Final = of_each("mirrored", in_mirror)
SWAPPED: Final = with_pictures(
    "red and blue swapped", lambda rgb: np.ascontiguousarray(rgb[..., ::-1])
)
ALL_BLACK: Final = with_pictures("black", np.zeros_like)
ALL_WHITE: Final = with_pictures("white", lambda rgb: np.full_like(rgb, 255))
NO_RETURNS: Final = of_each(
    "no returns",
    lambda seen: replace(seen, scan=None if seen.scan is None else clear_scan(seen.scan.spec)),
)
AT_REST: Final = of_each("standing", lambda seen: replace(seen, v_mps=0.0, w_radps=0.0))
LATER_S: Final = 3600.0
LATER: Final = of_each(
    "later",
    lambda seen: replace(
        seen, tick=seen.tick + Clock().ticks(LATER_S), time_s=seen.time_s + LATER_S
    ),
)


def showing(name: str, other: Observations, ages: Sequence[int] | None = None) -> Edit:
    """Return an edit that shows the pictures of another drive.

    ages: ages of the replaced observations, in answers; None for all. All other fields are
    unchanged.
    """

    def change(seen: Observations) -> list[Observation]:
        edited = list(seen)
        for age in range(len(seen)) if ages is None else ages:
            edited[-1 - age] = _seeing(seen[-1 - age], other[-1 - age])
        return edited

    return Edit(f"{name} {ages}", change)


def sensing(name: str, other: Observations, sensor: Literal["scan", "people"]) -> Edit:
    """Return an edit that gives the readings of one sensor in another drive of the same length."""

    def change(seen: Observations) -> list[Observation]:
        readings = [{sensor: getattr(one, sensor)} for one in other]
        return [replace(mine, **theirs) for mine, theirs in zip(seen, readings, strict=True)]

    return Edit(f"{sensor} of {name}", change)


def _seeing(mine: Observation, theirs: Observation) -> Observation:
    return replace(
        mine, rgb=theirs.rgb, depth=theirs.depth, labels=theirs.labels, pictures=theirs.pictures
    )


def then(
    first: Observations, second: Observations, clock: Clock, rate_hz: float
) -> list[Observation]:
    """Join two drives in one episode: the robot is put back to the start of the second one."""
    period = round(1.0 / (rate_hz * clock.tick_s))
    moved = []
    for number, one in enumerate(second):
        tick = first[-1].tick + (number + 1) * period
        moved.append(replace(one, tick=tick, time_s=clock.time_s(tick), reset=number == 0))
    return [*first, *moved]


def _flipped(picture: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if picture is None else flipped(picture)


def _camera_in_mirror(camera: Calibration, width_px: int) -> Calibration:
    matrix = camera.matrix.copy()
    matrix[0, 2] = width_px - 1 - matrix[0, 2]
    return Calibration(
        write_protect(matrix),
        camera.distortion,
        write_protect(_MIRROR @ camera.on_robot @ _MIRROR_PX),
    )
