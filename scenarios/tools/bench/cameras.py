"""Measures frames per second of the cameras in a busy street: `cosim bench camera`.

Every figure is taken in a process of its own, several rounds in turn; medians are shown. People
walk from frame to frame, so nothing of the last frame can be reused.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from cosim.core.errors import CosimError
from cosim.core.geometry import Floats, Polyline, Pose
from cosim.core.progress import Progress
from cosim.core.state import Doing, People, RobotState, Street, Vehicles
from cosim.place.street_map import StreetMap
from cosim.spec.camera import CameraSpec
from cosim.spec.options import CameraName
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import City
from scenarios.tools.bench.figures import alone

SIZE: Final = (512, 288)
PERSONS: Final = 50
CROWDED: Final = 500
TOGETHER: Final = 10
MANY: Final = 100
PERIOD_S: Final = 0.05
"""Time from frame to frame."""
_NEAREST_M: Final = 2.5
_FARTHEST_M: Final = 32.0
_STANDING: Final[tuple[Doing, ...]] = ("stand", "look", "talk", "stop")
_STRIDE_M: Final = 1.4


class BusyStreet(NamedTuple):
    """Street to draw: the robot, and the moving people and vehicles of each frame."""

    robot: RobotState
    streets: tuple[Street, ...]


def busy_street(street_map: StreetMap, persons: int, frames: int) -> BusyStreet:
    """Fill the view of a robot that looks along the longest sidewalk with people."""
    longest = max(
        (s for s in street_map.strips.values() if s.kind == "sidewalk"), key=lambda s: s.length_m
    )
    return busy_street_at(
        Pose(*Polyline(longest.line[:, :2]).at(0.3 * longest.length_m)), persons, frames
    )


def busy_street_at(pose: Pose, persons: int, frames: int) -> BusyStreet:
    """Fill the view of a robot at a pose with people, four of five of whom walk, and cars."""
    rng = np.random.default_rng(persons)
    x, y, heading = pose.x_m, pose.y_m, pose.heading_rad
    bearing = heading + rng.uniform(-0.6, 0.6, persons)
    away = np.sqrt(rng.uniform(_NEAREST_M**2, _FARTHEST_M**2, persons))
    start = np.array([x, y]) + away[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    facing = (
        heading + np.where(rng.random(persons) < 0.5, 0.0, math.pi) + rng.normal(0.0, 0.1, persons)
    )
    speed = np.where(rng.random(persons) < 0.8, rng.uniform(0.9, 1.7, persons), 0.0)
    doing = tuple(
        "walk" if v else _STANDING[i % len(_STANDING)] for i, v in enumerate(speed.tolist())
    )
    ids = tuple(f"c{i:04d}" for i in range(persons))
    cars = _cars(x, y, heading)

    def street(k: int) -> Street:
        walked = speed * PERIOD_S * k
        xy = start + walked[:, None] * np.column_stack([np.cos(facing), np.sin(facing)])
        people = People.of(ids, xy, facing, speed, doing, walked / _STRIDE_M, speed)
        return Street(k, people, cars(k * PERIOD_S))

    return BusyStreet(RobotState(Pose(x, y, heading)), tuple(map(street, range(frames))))


def _cars(x_m: float, y_m: float, heading_rad: float) -> Callable[[float], Vehicles]:
    """Return a function of time that gives eight moving cars on both sides of the robot."""
    count = 8
    along = np.linspace(5.0, 45.0, count)
    aside = np.where(np.arange(count) % 2 == 0, 6.0, -6.0)
    forward = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    left = np.array([-forward[1], forward[0]])
    sizes = np.tile([4.6, 1.8], (count, 1))

    def at(time_s: float) -> Vehicles:
        xy: Floats = (
            np.array([x_m, y_m]) + (along + 8.0 * time_s)[:, None] * forward + aside[:, None] * left
        )
        ids = tuple(f"v{i}" for i in range(count))
        return Vehicles.of(ids, xy, np.full(count, heading_rad), np.full(count, 8.0), sizes)

    return at


def camera_city(size_m: float) -> StreetMap:
    """Return the street map of the city of a size."""
    from sumo_nets.city.store import city_net
    from sumo_nets.net.snapshot import street_map_of

    return street_map_of(city_net(City(seed=5, size_m=size_m)))


def whole_frame(camera: CameraName, persons: int, frames: int, size_m: float) -> float:
    """Time a whole picture by `gl`, `bullet` or `bullet-egl`: arranged, drawn and read back.

    Returns: median seconds
    """
    from physics.cameras.choice import camera_of
    from physics.dynamics.world import BulletWorld
    from physics.street.street_surface import StreetSurface

    street_map = camera_city(size_m)
    world = BulletWorld(StreetSurface(street_map, 5))
    busy = busy_street(street_map, persons, frames)
    with camera_of(camera, world, CameraSpec(*SIZE, fov_deg=60.0)) as eyes:
        return median_s(lambda street: eyes.render(busy.robot, street), busy.streets)


def people_alone(persons: int, frames: int, size_m: float) -> float:
    """Time a picture of people alone; each is read back while the next is drawn.

    Returns: median seconds
    """
    from physics.cameras.gl.people_only import PeopleAlone

    busy = busy_street(camera_city(size_m), persons, frames)
    with PeopleAlone(SIZE, 60.0) as eyes:
        draw = one_ahead(lambda street: eyes.begin(busy.robot.pose, street), eyes.end)
        return median_s(draw, busy.streets)


def together(environments: int, frames: int, size_m: float) -> float:
    """Time pictures of several environments, drawn into one atlas and read back at once.

    Returns: median seconds of one environment's picture
    """
    from physics.cameras.gl.atlas import Atlas
    from physics.dynamics.world import BulletWorld
    from physics.street.street_surface import StreetSurface

    street_map = camera_city(size_m)
    world = BulletWorld(StreetSurface(street_map, 5))
    busy = busy_street(street_map, PERSONS, frames)
    spec = CameraSpec(*SIZE, fov_deg=60.0)
    with Atlas(spec) as eyes:
        keys = [eyes.join(world) for _ in range(environments)]
        draw = one_ahead(
            lambda street: eyes.begin([(key, busy.robot, street) for key in keys]), eyes.end
        )
        return median_s(draw, busy.streets) / environments


def median_s(draw: Callable[[Street], object], streets: tuple[Street, ...]) -> float:
    """Return the median seconds of a picture, once tiles and bodies are built.

    All streets are drawn before, because a new body takes ten times as long as a picture on a GPU.
    """
    for street in streets:
        draw(street)
    stamps = [time.perf_counter()]
    for street in streets:
        draw(street)
        stamps.append(time.perf_counter())
    return float(statistics.median(np.diff(stamps).tolist()))


def one_ahead(
    begin: Callable[[Street], object], end: Callable[[], object]
) -> Callable[[Street], None]:
    """Return a function that begins a picture, and then ends the one before."""
    begun = False

    def draw(street: Street) -> None:
        nonlocal begun
        begin(street)
        if begun:
            end()
        begun = True

    return draw


def _scanned(appearance: Appearance, count: int, frames: int, size_m: float) -> float:
    from scenarios.tools.bench.splats import scanned_frame

    return scanned_frame(appearance, count, PERSONS, frames, size_m)


def _scanned_together(size_m: float) -> float:
    from scenarios.tools.bench.splats import scanned_together

    return scanned_together(TOGETHER, 1_000_000, PERSONS, 12, size_m)


class Drawing(NamedTuple):
    """Row of the table.

    work: function of a city's size that returns the seconds of a picture
    least_fps: targets without and with a GPU
    """

    name: str
    work: Callable[[float], float]
    size_m: float = 2000.0
    least_fps: tuple[float | None, float | None] = (None, None)


WHOLE: Final = "whole frame, gl"
PEOPLE: Final = "people alone, gl"
TINY: Final = "whole frame, bullet (TinyRenderer)"
EGL: Final = "whole frame, bullet (EGL plugin)"
SCANNED: Final = "scan, 0.27 M splats, gl"
_SCANNED_MESH: Final = "scan, mesh, gl"
_SCAN_CITY_M: Final = 200.0
_SMALL: Final = "whole frame, gl, 0.2 km city"

FIGURES: Final = (
    Drawing(WHOLE, partial(whole_frame, "gl", PERSONS, 120), least_fps=(120.0, 1200.0)),
    Drawing(PEOPLE, partial(people_alone, PERSONS, 200), least_fps=(300.0, 2500.0)),
    Drawing(TINY, partial(whole_frame, "bullet", PERSONS, 20)),
    Drawing(EGL, partial(whole_frame, "bullet-egl", PERSONS, 20)),
    Drawing(_SMALL, partial(whole_frame, "gl", PERSONS, 120), 200.0),
    Drawing(
        f"whole frame, gl, {CROWDED} people",
        partial(whole_frame, "gl", CROWDED, 60),
        least_fps=(None, 500.0),
    ),
    Drawing(
        f"{TOGETHER} environments in an atlas, gl",
        partial(together, TOGETHER, 40),
        least_fps=(None, 6000.0),
    ),
    Drawing(
        f"{MANY} environments in an atlas, gl",
        partial(together, MANY, 20),
        least_fps=(None, 10000.0),
    ),
    Drawing(
        SCANNED,
        partial(_scanned, "splats", 270_000, 50),
        _SCAN_CITY_M,
        least_fps=(8.0, 300.0),
    ),
    Drawing(
        _SCANNED_MESH,
        partial(_scanned, "mesh", 1000, 100),
        _SCAN_CITY_M,
        least_fps=(80.0, None),
    ),
    Drawing(
        "scan, 1 M splats, gl",
        partial(_scanned, "splats", 1_000_000, 30),
        _SCAN_CITY_M,
        least_fps=(None, 150.0),
    ),
    Drawing(
        "scan, 3 M splats, gl",
        partial(_scanned, "splats", 3_000_000, 20),
        _SCAN_CITY_M,
        least_fps=(None, 60.0),
    ),
    Drawing(
        f"{TOGETHER} environments in a scan of 1 M splats, gl",
        _scanned_together,
        _SCAN_CITY_M,
        least_fps=(None, 400.0),
    ),
)


RATIOS: Final = (
    ("gl / TinyRenderer", WHOLE, TINY, ">= 5"),
    ("gl / EGL plugin", WHOLE, EGL, ">= 5"),
    ("scan: splats / mesh", SCANNED, _SCANNED_MESH, ""),
    ("time in a 2 km city / 0.2 km city", _SMALL, WHOLE, "<= 1.1"),
)
"""Ratios: name, figures above and below the line, target."""


class _Found(NamedTuple):
    """Frames per second of a figure in each round; why: the reason where there are none."""

    fps: list[float]
    why: str = ""


def time_cameras(rounds: int, progress: Progress) -> dict[str, _Found]:
    """Measure every figure `rounds` times, each in a fresh process.

    A figure that fails is not repeated.
    """
    found = {figure.name: _Found([]) for figure in FIGURES}
    for i in range(rounds):
        for figure in FIGURES:
            if found[figure.name].why:
                continue
            progress(f"measuring: round {i + 1} of {rounds}: {figure.name}")
            try:
                found[figure.name].fps.append(1.0 / alone(figure.work, figure.size_m))
            except CosimError as error:
                found[figure.name] = _Found([], str(error))
            except Exception as error:  # noqa: BLE001  a library or a driver may fail in any way; reported
                found[figure.name] = _Found([], f"{type(error).__name__}: {error}")
    return found
