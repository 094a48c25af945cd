"""Whether people that sensors report are in pictures from the same eye. Usage: python -m
tests.support.tracked [FRAMES], in crowds of a generated and of an imported place."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.core.state import LABELS, Frame, RobotState, Street
from cosim.policies.privileged.route import Route
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import Mount, robot_called
from cosim.spec.scenario import CityMap, CrowdSpec, Scenario
from cosim.spec.sensors import TRACKING_RANGE_M
from physics.sensors.caster import RayCaster
from scenarios.episodes.episode import Episode
from scenarios.places.nets import surface_of_place
from scenarios.suites.catalog import load_suite

_BODY_M = 0.8
"""Largest distance in m of a pixel of a person's body from the person's position."""


class Blind(Route):
    """Drives the route without a camera."""

    manifest = Route.manifest.__class__("blind-route", rate_hz=10.0, camera=None, privileged=True)


class Reported(NamedTuple):
    """Reports of one frame.

    shown: (N,) for each reported person in the picture, whether a pixel shows the body.
    missed: people with many pixels who are not reported.
    """

    shown: NDArray[np.bool_]
    missed: int


def camera_at(eye_m: float) -> CameraSpec:
    """Return a level camera above the middle of a robot."""
    mount = Mount((0.0, 0.0, eye_m))
    return CameraSpec(512, 288, fov_deg=60.0, mount=mount, depth=True, labels=True)


def pixels_of(frame: Frame, at: Floats, spec: CameraSpec) -> NDArray[np.intp]:
    """Return the (N,) numbers of pixels of people's bodies; a pixel is that of the nearest person.

    at: (N, 2) people ahead and to the left of the eye, metres.
    """
    assert frame.labels is not None and frame.depth is not None
    focal = 0.5 * spec.height / math.tan(math.radians(0.5 * spec.fov_deg))
    rows, columns = np.nonzero(frame.labels == LABELS["person"])
    depth = frame.depth[rows, columns]
    left = (0.5 * spec.width - 0.5 - columns) / focal * depth
    far = np.hypot(depth[:, None] - at[:, 0], left[:, None] - at[:, 1])
    nearest = far.argmin(axis=1)
    near = far[np.arange(len(far)), nearest] < _BODY_M
    return np.bincount(nearest[near], minlength=len(at))


def reports(scenario: Scenario, frames: int) -> Iterator[Reported]:
    """Drive a scenario and yield what each frame says of the people that are reported."""
    robot = robot_called(scenario.robot)
    eye_m = robot.mount("front").at_m[2]
    spec = camera_at(eye_m)
    policy = Blind()
    surface = surface_of_place(scenario.place)
    with (
        Episode(scenario, policy.manifest) as episode,
        episode.eyes(spec) as camera,
        RayCaster(surface, scenario.barriers, scenario.obstacles, robot, TRACKING_RANGE_M) as rays,
    ):
        policy.reset(episode.id, episode.seed)
        seen = episode.reset()
        for _ in range(frames):
            now = episode.moment
            frame = camera.render(now.robot, now.street)
            rows = rays.seen_people(now.robot, now.street, eye_m, TRACKING_RANGE_M)
            yield _judged(frame, now.robot, now.street, rows, spec)
            if episode.over:
                return
            seen = episode.advance(policy.act(seen))


def _judged(
    frame: Frame,
    robot: RobotState,
    street: Street,
    rows: NDArray[np.intp],
    spec: CameraSpec,
) -> Reported:
    """Return which reported people are in the picture."""
    x, y, heading = robot.pose
    cos, sin = math.cos(heading), math.sin(heading)
    to = street.people.xy - (x, y)
    ahead, left = cos * to[:, 0] + sin * to[:, 1], cos * to[:, 1] - sin * to[:, 0]
    half = math.tan(math.radians(0.5 * spec.fov_deg)) * spec.width / spec.height
    if not len(to):
        return Reported(np.zeros(0, dtype=bool), 0)
    inside = (ahead > 1.0) & (np.abs(left) < 0.9 * half * ahead - 0.3)
    inside &= np.hypot(ahead, left) < TRACKING_RANGE_M
    pixels = pixels_of(frame, np.column_stack([ahead, left]), spec)
    reported = np.zeros(len(pixels), dtype=bool)
    reported[rows] = True
    missed = int((inside & ~reported & (pixels > 100)).sum())
    return Reported(pixels[inside & reported] > 0, missed)


def main(frames: int) -> None:
    """Print how many people are reported in the picture, and how many of these are hidden."""
    ways = load_suite("long-horizon").scenarios
    crowd = CrowdSpec(persons=150, radius_m=45.0, vehicles=20)
    for real in (False, True):
        way = next(one for one in ways if isinstance(one.place, CityMap) is real)
        found = [*reports(msgspec.structs.replace(way, crowd=crowd), frames)]
        shown = np.concatenate([one.shown for one in found])
        missed = sum(one.missed for one in found)
        print(
            f"{way.id}: {len(found)} frames, {len(shown)} reported people in the picture, "
            f"{int((~shown).sum())} of them hidden; {missed} not reported with over 100 pixels"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
