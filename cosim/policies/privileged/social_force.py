"""`social_force`: repulsion by people and edges, attraction by the goal.

Goal and edges: D. Helbing, P. Molnar, "Social force model for pedestrian dynamics", Physical Review
E 51, 4282 (1995), without attraction by friends and shop windows. People: A. Johansson, D. Helbing,
P. Shukla, "Specification of the social force pedestrian model by evolutionary adjustment to video
tracking data", Advances in Complex Systems 10, 271 (2007), second elliptical form, fitted to tracks
of people. The force of 1995 is too short-ranged for a robot that turns slowly.

The papers model people as points that step sideways freely and fluctuate at random. Here distances
are between the outlines of robot and person. The robot turns towards the velocity that the forces
would give, and passes people head-on on the right.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import shapely

from cosim.core.geometry import Floats, wrap_angle
from cosim.core.state import PERSON_RADIUS_M, Command, People
from cosim.episode.control import clipped
from cosim.episode.interfaces import Observation, Privileged
from cosim.policies.privileged.route import crossing_limit
from cosim.spec.manifest import Manifest
from cosim.spec.robot import Robot

DESIRED_MPS: Final = 1.34
"""Mean desired speed of the paper in m/s; limited by the robot's cruising speed."""
RELAXATION_S: Final = 0.5
"""Relaxation time tau in seconds towards the desired velocity."""
PEOPLE_MPS2: Final = 4.30
"""Strength A of the repulsion by people in m/s^2."""
PEOPLE_M: Final = 1.07
"""Range B of the repulsion by people in metres."""
STEP_AHEAD_S: Final = 0.5
"""Delta t in seconds: relative motion over this time stretches the ellipse."""
BEHIND_WEIGHT: Final = 0.06
"""Anisotropy lambda: weight of a person directly behind."""
LEANS_RAD: Final = math.radians(15.0)
"""Rotation of pushes in radians, so that the robot passes people straight ahead on their right."""
EDGES_M2PS2: Final = 10.0
"""Repulsive potential U0 of edges in m^2/s^2."""
EDGES_M: Final = 0.2
"""Range R of the repulsive potential of edges in metres."""
ACTS_FOR_S: Final = 0.5
"""Seconds over which forces change the velocity to obtain the one to turn to."""
TOUCHING_M: Final = 0.05
"""Lower bound of distances between outlines in metres, which bounds the force."""
_LOOK_M: Final = 2.0
"""Look-ahead distance in metres along the route."""
_GAIN_PER_S: Final = 2.0
"""Gain of the turning rate on the bearing in 1/s."""
_NEAR_M: Final = 8.0
"""Metres within which people push."""


class SocialForce:
    """Social force model (Helbing and Molnar 1995) along the reference route; privileged."""

    manifest = Manifest("social_force", version="3", rate_hz=10.0, camera=None, privileged=True)

    def reset(self, episode_id: str, seed: int) -> None:
        """Do nothing: the policy has no state."""

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        if known is None:
            raise ValueError("policy social_force needs privileged state")
        robot, state = observation.robot, known.robot
        heading = state.pose.heading_rad
        velocity = state.v_mps * np.array([math.cos(heading), math.sin(heading)])
        wanted = velocity + ACTS_FOR_S * force(known, robot, velocity)
        speed = min(math.hypot(*wanted), 1.3 * desired_mps(robot), crossing_limit(known, robot))
        off_rad = wrap_angle(math.atan2(wanted[1], wanted[0]) - heading)
        return clipped(Command(speed * max(math.cos(off_rad), 0.0), _GAIN_PER_S * off_rad), robot)


def desired_mps(robot: Robot) -> float:
    """The speed that its goal pulls a robot to."""
    return min(DESIRED_MPS, robot.cruise_mps)


def force(known: Privileged, robot: Robot, velocity: Floats) -> Floats:
    """The acceleration (2,) m/s2 of a robot that drives at `velocity` (2,)."""
    here = known.robot.pose.xy
    ahead = known.route.at(min(known.route_s_m + _LOOK_M, known.route.length_m)).xy - here
    direction = ahead / max(math.hypot(*ahead), 1e-9)
    pull = (desired_mps(robot) * direction - velocity) / RELAXATION_S
    pushes = weighted_pushes(people_pushes(known.people, robot, here, velocity), direction)
    total: Floats = pull + pushes.sum(axis=0) + edge_push(known, robot, here)
    return total


def contact_distance_m(robot: Robot) -> float:
    """Return the distance in metres between the centres of the robot and a person 1 cm ahead of
    it."""
    return robot.length_m / 2 + 0.01 + PERSON_RADIUS_M


def people_pushes(people: People, robot: Robot, here: Floats, velocity: Floats) -> Floats:
    """Return (N, 2) in m/s^2: the push of each person on the robot.

    Let d point from person to robot between their outlines, and y be the person's motion relative
    to the robot in Delta t. With 2 b = sqrt((|d| + |d - y|)^2 - |y|^2), the push is A exp(-b / B)
    (|d| + |d - y|) / 2 b along the mean of the directions of d and d - y.

    here: (2,) the robot's position in metres.
    velocity: (2,) the robot's velocity in m/s.
    """
    away = here - people.xy
    r = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
    away = away * (np.maximum(r - contact_distance_m(robot), TOUCHING_M) / r)[:, None]
    going = people.speed[:, None] * np.column_stack(
        [np.cos(people.heading), np.sin(people.heading)]
    )
    step = STEP_AHEAD_S * (going - velocity)
    from_step = away - step
    near = np.hypot(away[:, 0], away[:, 1])
    then = np.maximum(np.hypot(from_step[:, 0], from_step[:, 1]), 1e-9)
    both = near + then
    b = 0.5 * np.sqrt(np.maximum(both**2 - (step**2).sum(axis=1), (2 * TOUCHING_M) ** 2))
    along = 0.5 * (away / near[:, None] + from_step / then[:, None])
    strength = PEOPLE_MPS2 * np.exp(-b / PEOPLE_M) * both / (2.0 * b) * (r < _NEAR_M)
    pushes: Floats = strength[:, None] * along
    return pushes


def weighted_pushes(pushes: Floats, direction: Floats) -> Floats:
    """Rotate pushes (N, 2) by LEANS_RAD and weight them by direction.

    w = lambda + (1 - lambda) (1 + cos) / 2.
    """
    strength = np.maximum(np.hypot(pushes[:, 0], pushes[:, 1]), 1e-9)
    ahead = -pushes @ direction / strength
    cos, sin = math.cos(LEANS_RAD), math.sin(LEANS_RAD)
    weight = BEHIND_WEIGHT + (1.0 - BEHIND_WEIGHT) * 0.5 * (1.0 + ahead)
    weighed: Floats = pushes * weight[:, None] @ np.array([[cos, sin], [-sin, cos]])
    return weighed


def edge_push(known: Privileged, robot: Robot, here: Floats) -> Floats:
    """Return (2,) in m/s^2: the push of the nearest edge into the free area."""
    point = shapely.Point(here)
    edge = known.free.boundary
    nearest = np.asarray(edge.interpolate(edge.project(point)).coords[0])
    away = here - nearest
    distance_m = max(math.hypot(*away), 1e-6)
    inward = away / distance_m if shapely.contains_xy(known.free, *here) else -away / distance_m
    inside_m = distance_m if shapely.contains_xy(known.free, *here) else 0.0
    push: Floats = (
        EDGES_M2PS2 / EDGES_M * math.exp(-(inside_m + robot.width_m / 2.2) / EDGES_M) * inward
    )
    return push
