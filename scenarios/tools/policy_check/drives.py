"""Drives that are shown to a policy: short ways along a real street of a suite.

The sensors of the policy see them without a simulation. Its answers do not affect the next
observation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Final, Literal

import msgspec
import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Polyline, Pose, wrap_angle
from cosim.core.progress import Progress, ignore
from cosim.core.state import NO_PEOPLE, Age, People, PersonKind, RobotState, Street
from cosim.episode.interfaces import Observation, ViewCamera
from cosim.episode.loop import Moment
from cosim.episode.manifest_checks import check_camera
from cosim.episode.observer import Observer
from cosim.episode.sensing import sensing_range_m
from cosim.spec.manifest import Manifest
from cosim.spec.options import CameraName
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario
from physics.cameras.choice import camera_of
from physics.dynamics.world import BulletWorld
from physics.people.appearance import look_of
from physics.people.body import COATS
from physics.people.wardrobe import Season, season_of
from physics.sensors.caster import RayCaster
from physics.street.surface import PlaceSurface
from scenarios.episodes.wiring import draw_empty_street, privileged_source, route_corridor
from scenarios.places.nets import place, surface_of_place
from scenarios.suites.catalog import load_suite

SceneName = Literal["straight", "left", "right", "person"]
SCENES: Final[Mapping[SceneName, str]] = MappingProxyType(
    {
        "straight": "along a straight sidewalk without people",
        "left": "askew on it, to the right: the way leads to the left",
        "right": "askew on it, to the left: the way leads to the right",
        "person": "along it, and three people stand 3 m ahead",
    }
)
_PERSONS: Final = 3
"""Number of people ahead. Several, as the clothes of one may be hard to see."""
_CANDIDATES: Final = 200
"""Number of names of whom those in the yellowest clothes are shown, for `colour_order`."""
_APART_M: Final = 0.65
"""Distance between their middles in metres."""
_SHOWN: Final = "straight-003"
"""Scenario of the suite `unit` whose place is shown.

The way is 18 m long and has lawns on both sides. No large object is close to the camera: a policy
that stops for one has no turn to compare, and `colour_order` and `side` would judge it wrongly.
"""
_SPEED_MPS: Final = 1.0
_ASKEW_RAD: Final = math.radians(20.0)
_ASIDE_M: Final = 0.5
"""Distance from the middle of the sidewalk at the newest picture of an askew drive, in metres."""
_PERSON_M: Final = 3.0
_FARTHEST_BACK_M: Final = 4.5
"""Largest distance before the newest picture, in metres. In older observations the robot is at
rest.
"""


@dataclass(frozen=True, slots=True)
class ShownDrive:
    """Drive that is shown to a policy: an observation for each of its answers, oldest first."""

    scene: SceneName
    seen: tuple[Observation, ...]


def shown_drives(
    manifest: Manifest,
    count: int,
    camera: CameraName,
    own_camera: bool = False,
    progress: Progress = ignore,
) -> dict[SceneName, ShownDrive]:
    """Return the drives of all scenes with `count` observations each.

    Raises UsageError for a camera that the robot lacks.
    """
    (shown,) = (one for one in load_suite("unit").scenarios if one.id == _SHOWN)
    shown = msgspec.structs.replace(shown, obstacles=())
    check_camera(manifest, robot_called(shown.robot), own_camera)
    drives = {}
    for done, scene in enumerate(SCENES):
        progress("drawing streets", done / len(SCENES))
        drives[scene] = _shown_drive(scene, shown, manifest, count, camera)
    return drives


def _pose(route: Polyline, scene: SceneName, back_m: float) -> Pose:
    """Return the pose of the robot `back_m` before its newest picture."""
    middle = route.at(0.5 * route.length_m)
    side = {"left": -1.0, "right": 1.0}.get(scene, 0.0)
    heading = wrap_angle(middle.heading_rad + side * _ASKEW_RAD)
    x_m = middle.x_m - side * _ASIDE_M * math.sin(middle.heading_rad) - back_m * math.cos(heading)
    y_m = middle.y_m + side * _ASIDE_M * math.cos(middle.heading_rad) - back_m * math.sin(heading)
    return Pose(x_m, y_m, heading)


def _shown_drive(
    scene: SceneName, scenario: Scenario, manifest: Manifest, count: int, camera: CameraName
) -> ShownDrive:
    """Compute the observations of a drive along a scene, without simulating it."""
    robot = robot_called(scenario.robot)
    route = scenario.route_line
    surface = surface_of_place(scenario.place)
    clock = Clock.for_rate(manifest.rate_hz)
    season = season_of(scenario.light.day_of_year, scenario.light.latitude_deg)
    people = (
        _standing_people(route, 0.5 * route.length_m + _PERSON_M, surface.seed, season)
        if scene == "person"
        else NO_PEOPLE
    )
    seen = []
    with ExitStack() as stack:
        observer, eye = _observer(stack, scenario, manifest, camera, surface)
        for number in range(count):
            time_s = number / manifest.rate_hz
            back_m = _SPEED_MPS * (count - 1 - number) / manifest.rate_hz
            pose = _pose(route, scene, min(back_m, _FARTHEST_BACK_M))
            v_mps = _SPEED_MPS if back_m <= _FARTHEST_BACK_M else 0.0
            z_m, _, _ = surface.lean(pose, robot.drive.span_m)
            s_m, _ = route.project(pose.x_m, pose.y_m)
            tick = clock.ticks(time_s)
            now = Moment(tick, RobotState(pose, v_mps, z_m=z_m), Street(tick, people), s_m)
            one, _ = observer.observed(now, time_s, eye, False)
            if manifest.odometry == "gps" and one.odometry is not None:
                one = replace(one, odometry=msgspec.structs.replace(one.odometry, heading_rad=None))
            seen.append(one)
    return ShownDrive(scene, tuple(seen))


def _observer(
    stack: ExitStack,
    scenario: Scenario,
    manifest: Manifest,
    camera: CameraName,
    surface: PlaceSurface,
) -> tuple[Observer, ViewCamera | None]:
    """Return the observer of a scenario without engines, and the policy's first camera.

    stack: closes its cameras and rays
    """
    robot = robot_called(scenario.robot)
    street_map = place(scenario.place)[1]
    walkable = street_map.walkable_near(route_corridor(scenario))
    world = stack.enter_context(BulletWorld(surface, robot=robot))
    cameras = {
        name: stack.enter_context(
            camera_of(
                camera,
                world,
                spec,
                light=scenario.light,
                weather=scenario.conditions,
                depth=spec.depth,
            )
        )
        for name, spec in {"": manifest.camera, **manifest.cameras}.items()
        if spec is not None
    }
    eye = cameras.pop("", None)
    look = None if eye is None else partial(draw_empty_street, eye, surface, robot)
    rays: RayCaster | None = None
    if range_m := sensing_range_m(manifest):
        rays = stack.enter_context(RayCaster(surface, (), (), robot, range_m))
    exact = replace(manifest, odometry="none" if manifest.odometry == "none" else "exact")
    observer = Observer(
        scenario,
        exact,
        0,
        privileged_source(scenario, robot, surface, street_map, walkable),
        cameras,
        look,
        rays,
    )
    return observer, eye


def _standing_people(route: Polyline, s_m: float, seed: int, season: Season) -> People:
    """Return adults side by side around the middle of the way, facing the robot.

    seed, season: of their clothes
    """
    pose = route.at(s_m)
    across = np.array([-math.sin(pose.heading_rad), math.cos(pose.heading_rad)])
    aside = _APART_M * (np.arange(_PERSONS) - 0.5 * (_PERSONS - 1))
    heading = wrap_angle(pose.heading_rad + math.pi)

    def yellow(name: str) -> int:
        colours = look_of(name, Age.ADULT, seed, season, crowd=False).colours
        red, green, blue = colours[[COATS.index("top"), COATS.index("bottom")]].astype(int).T
        return int((np.minimum(red, green) - blue).sum())

    names = [f"person-{k}" for k in range(_CANDIDATES)]
    return People.of(
        tuple(sorted(names, key=yellow, reverse=True)[:_PERSONS]),
        np.array(pose.xy) + aside[:, None] * across,
        [heading] * _PERSONS,
        [0.0] * _PERSONS,
        ("stand",) * _PERSONS,
        kind=PersonKind.EVENT,
    )
