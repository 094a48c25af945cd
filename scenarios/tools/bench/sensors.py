"""Measures the sensors in a busy street: a scan of 360 rays and the visible people.

Times are of one thread. They are compared with PyBullet's rays on the same shapes.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Final

import numpy as np

from cosim.core.geometry import Floats, Pose
from cosim.core.state import Doing, People, RobotState, Street, Trunk, Vehicles
from cosim.spec.robot import COURIER
from cosim.spec.sensors import TRACKING_RANGE_M, ScanSpec
from physics.dynamics.bodies import Bodies
from physics.dynamics.drive import SUBSTEP_S
from physics.dynamics.movers import Mover
from physics.ground.tiles import tiles_within
from physics.robots.kinematics import attitude
from physics.sensors.caster import RayCaster, sensor_frame
from physics.street.surface import Surface
from scenarios.tools.bench.environment import scenario_in
from scenarios.tools.bench.figures import Figure

_PLACES: Final = 12
_REPEATS: Final = 40
_PEOPLE: Final = 20
_VEHICLES: Final = 4
_AROUND_M: Final = 15.0
_LEAN_RAD: Final = 0.03
"""Angle by which a robot on uneven ground leans, so that half of its rays reach the ground."""
_SPEC: Final = ScanSpec()
_EYE_M: Final = COURIER.mount("front").at_m[2]


def sensing() -> list[Figure]:
    """Measure a scan on level and on uneven ground, and tracked people; medians over places."""
    from scenarios.places.nets import surface_of_place

    scenario = scenario_in(2000.0)
    surface = surface_of_place(scenario.place)
    draws = np.random.default_rng(7)
    route = np.array(scenario.route)
    times: dict[str, list[float]] = {"level": [], "leaning": [], "people": [], "bullet": []}
    with RayCaster(surface, (), (), COURIER, _SPEC.range_m) as rays:
        for x, y in route[np.linspace(0, len(route) - 1, _PLACES).astype(int)].tolist():
            pose = Pose(x, y, float(draws.uniform(-math.pi, math.pi)))
            street = _busy_street(draws, pose)
            level, leaning = (_robot(surface, pose, lean) for lean in (0.0, _LEAN_RAD))
            times["level"].append(_median_ms(partial(_scan, rays, level, street)))
            times["leaning"].append(_median_ms(partial(_scan, rays, leaning, street)))
            look = partial(rays.seen_people, level, street, _EYE_M, TRACKING_RANGE_M)
            times["people"].append(_median_ms(look))
            times["bullet"].append(_bullet_ms(surface, level, street))
    ms = {name: statistics.median(values) for name, values in times.items()}
    peer = "PyBullet's rays on the same shapes"
    return [
        Figure("scan of 360 rays, level, ms", ms["level"], ms["bullet"], peer, reach=0.3),
        Figure("scan of 360 rays, leaning, ms", ms["leaning"], ms["bullet"], peer),
        Figure("visible people of 20, ms", ms["people"], ms["bullet"], peer, reach=0.2),
    ]


def _scan(rays: RayCaster, robot: RobotState, street: Street) -> Floats:
    return rays.distances(robot, street, _SPEC.height_m, _SPEC.directions, _SPEC.range_m)


def _median_ms(work: Callable[[], object]) -> float:
    """Return the median CPU time of repeated calls in ms."""
    work()
    found = []
    for _ in range(_REPEATS):
        began_s = time.process_time()
        work()
        found.append(1000.0 * (time.process_time() - began_s))
    return statistics.median(found)


def _robot(surface: Surface, pose: Pose, pitch_rad: float) -> RobotState:
    z_m = float(surface.heights([pose[:2]])[0])
    still = (0.0, 0.0, 0.0)
    return RobotState(
        pose, z_m=z_m, trunk=Trunk(attitude(0.0, pitch_rad, pose.heading_rad), still, still)
    )


def _busy_street(draws: np.random.Generator, at: Pose) -> Street:
    """Return people and vehicles around a pose."""
    xy = at.xy + draws.uniform(-_AROUND_M, _AROUND_M, (_PEOPLE, 2)) / math.sqrt(2.0)
    names = tuple(map(str, range(_PEOPLE)))
    doing: tuple[Doing, ...] = ("walk",) * _PEOPLE
    turns = draws.uniform(-math.pi, math.pi, _PEOPLE + _VEHICLES)
    people = People.of(names, xy, turns[:_PEOPLE], np.ones(_PEOPLE), doing)
    cars = at.xy + draws.uniform(5.0, _AROUND_M, (_VEHICLES, 2)) * draws.choice(
        [-1.0, 1.0], (_VEHICLES, 2)
    )
    size = np.tile([4.5, 1.8], (_VEHICLES, 1))
    vehicles = Vehicles.of(names[:_VEHICLES], cars, turns[_PEOPLE:], np.zeros(_VEHICLES), size)
    return Street(0, people, vehicles)


def _bullet_ms(surface: Surface, robot: RobotState, street: Street) -> float:
    """Return the duration of the same rays by PyBullet in ms."""
    people, vehicles = street.people, street.vehicles
    x, y, _ = robot.pose
    with closing(Bodies(COURIER, SUBSTEP_S)) as bodies:
        for key in tiles_within(x, y, _SPEC.range_m):
            bodies.add_chunk(surface.chunk(key))
        walkers = [Mover(n, (0.6, 0.6), Pose(*p)) for n, p in _posed(people)]
        cars = [Mover(n, (4.5, 1.8), Pose(*p)) for n, p in _posed(vehicles)]
        bodies.activate("pedestrian", walkers)
        bodies.activate("vehicle", cars)
        feet = surface.heights(people.xy).tolist()
        bodies.set_paths("pedestrian", {one: one.poses(1) for one in walkers}, feet)
        bodies.set_paths("vehicle", {one: one.poses(1) for one in cars}, [0.0] * len(cars))
        bodies.place_robot((x, y, -30.0), (0.0, 0.0, 0.0))
        bodies.place_on_paths(0)
        origin, turn = sensor_frame(surface, COURIER, robot, _SPEC.height_m)
        begin = np.tile(origin, (_SPEC.rays, 1))
        end = begin + _SPEC.range_m * (np.array(turn) @ _SPEC.directions).T
        return _median_ms(lambda: bodies.hit_shares(begin, end))


def _posed(things: People | Vehicles) -> list[tuple[str, tuple[float, float, float]]]:
    """Return each name with x, y and heading."""
    rows = np.column_stack([things.xy, things.heading]).tolist()
    return [(name, (x, y, turn)) for name, (x, y, turn) in zip(things.ids, rows, strict=True)]
