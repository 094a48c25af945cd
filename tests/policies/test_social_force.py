"""Social forces: compared with the gradient of their potential, and in simple cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from shapely.geometry import box

from cosim.core.geometry import Polyline, Pose
from cosim.core.state import NO_PEOPLE, NO_VEHICLES, People, RobotState
from cosim.episode.interfaces import Privileged
from cosim.policies.privileged.social_force import (
    DESIRED_MPS,
    RELAXATION_S,
    contact_distance_m,
    edge_push,
    force,
    people_pushes,
    weighted_pushes,
)
from cosim.spec.robot import COURIER


def walker(x_m: float, y_m: float, heading_rad: float, speed_mps: float) -> People:
    return People.of(("c0",), [(x_m, y_m)], [heading_rad], [speed_mps], ("walk",))


def potential(people: People, d: np.ndarray, velocity: np.ndarray) -> float:
    """Return A B exp(-b / B) with the paper's b; d (2,) is metres from person to robot, between
    outlines."""
    heading = people.heading[0]
    y = 0.5 * (people.speed[0] * np.array([math.cos(heading), math.sin(heading)]) - velocity)
    both = math.hypot(*d) + math.hypot(*(d - y))
    return 4.30 * 1.07 * math.exp(-0.5 * math.sqrt(both**2 - float(y @ y)) / 1.07)


@pytest.mark.parametrize("d", [(-1.3, 0.0), (-0.8, 0.6), (-1.2, -0.8)])
def test_a_push_is_minus_the_slope_of_the_potential(d: tuple[float, float]) -> None:
    """Differences of the potential over 1 mm agree with the push."""
    person = walker(2.0, 0.3, 2.8, 1.3)
    at = np.array(d)
    velocity = np.array([1.0, 0.2])
    h = 1e-3
    slope = [
        (potential(person, at + h * axis, velocity) - potential(person, at - h * axis, velocity))
        / (2 * h)
        for axis in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    ]
    here = person.xy[0] + at * (1.0 + contact_distance_m(COURIER) / math.hypot(*at))
    assert people_pushes(person, COURIER, here, velocity)[0] == pytest.approx(
        -np.array(slope), rel=1e-3, abs=1e-6
    )


def test_pushes_from_behind_are_weak_and_pushes_lean_to_the_right() -> None:
    """A push from ahead has full weight, one from behind 6 %; a person straight ahead pushes
    slightly to the right."""
    ahead, behind = weighted_pushes(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([1.0, 0.0]))
    assert np.hypot(*ahead) == pytest.approx(1.0) and np.hypot(*behind) == pytest.approx(0.06)
    assert ahead[0] < -0.9 and -0.3 < ahead[1] < -0.2


def scene(y_m: float, others: People = NO_PEOPLE) -> Privileged:
    """A robot at rest beside a route along the x axis, on a walkway free for 1.5 m on either side."""
    robot = RobotState(Pose(5.0, y_m, 0.0), 0.0)
    route = Polyline([(0.0, 0.0), (30.0, 0.0)])
    return Privileged(robot, route, 5.0, others, NO_VEHICLES, {}, (), box(-5.0, -1.5, 35.0, 1.5))


def test_a_robot_alone_is_pulled_along_its_route_and_off_edges() -> None:
    """In the middle the goal pulls with v0 / tau; near and beyond the left edge the push is to the
    right, and grows."""
    assert force(scene(0.0), COURIER, np.zeros(2))[0] == pytest.approx(
        DESIRED_MPS / RELAXATION_S, rel=1e-3
    )
    near, beyond = (
        edge_push(scene(1.3), COURIER, np.array([5.0, 1.3])),
        edge_push(scene(1.6), COURIER, np.array([5.0, 1.6])),
    )
    assert near[0] == pytest.approx(0.0, abs=1e-9) and near[1] < 0.0
    assert beyond[1] < near[1]


def test_an_oncoming_person_on_the_left_pushes_back_and_right() -> None:
    """The walker is 2 m ahead, 0.3 m left, and comes closer."""
    alone, met = (
        force(scene(0.0, people), COURIER, np.zeros(2))
        for people in (NO_PEOPLE, walker(7.0, 0.3, math.pi, 1.3))
    )
    assert met[0] < alone[0] and met[1] < alone[1] - 0.1
