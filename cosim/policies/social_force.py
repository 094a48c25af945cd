"""`social_force`: people and edges push the robot, its goal pulls it.

Source: D. Helbing, P. Molnar, "Social force model for pedestrian dynamics", Physical Review E 51, 4282 (1995); its
constants are named below. Its attractions by friends and shop windows are left out. Its walkers step sideways at will;
this robot turns towards the velocity that the forces would give it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import shapely

from cosim.geometry import Floats, wrap_angle
from cosim.policies.route import W_RADPS, crossing_limit
from cosim.ports import Manifest, Observation, Privileged
from cosim.state import Command, People

DESIRED_MPS: Final = 1.34
"""The paper's mean desired speed."""
RELAXATION_S: Final = 0.5
"""tau: how fast the desired velocity is taken up again."""
PEOPLE_M2PS2: Final = 2.1
PEOPLE_M: Final = 0.3
"""V0 and sigma of the repulsive potential of people."""
STEP_AHEAD_S: Final = 2.0
"""Delta t: the space that somebody needs for the next step is so long."""
EDGES_M2PS2: Final = 10.0
EDGES_M: Final = 0.2
"""U0 and R of the repulsive potential of edges."""
HALF_VIEW_RAD: Final = math.radians(100.0)
UNSEEN: Final = 0.5
"""What happens behind counts for so much (c): outside an angle of 200 degrees."""

ACTS_FOR_S: Final = 0.5
"""Forces change the velocity over this time to give the one that the robot turns to."""
LOOK_M: Final = 2.0
GAIN_PER_S: Final = 2.0
NEAR_M: Final = 8.0


class SocialForce:
    """Pushed by people and edges, pulled along its route (Helbing and Molnar 1995); knows what no camera sees."""

    manifest = Manifest("social_force", version="1", rate_hz=10.0, camera=None, privileged=True)

    def reset(self, scenario_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        if known is None:
            raise ValueError("the social_force policy needs privileged observations")
        robot = known.robot
        heading = robot.pose.heading_rad
        velocity = robot.v_mps * np.array([math.cos(heading), math.sin(heading)])
        wanted = velocity + ACTS_FOR_S * force(known, velocity)
        speed = min(math.hypot(*wanted), 1.3 * DESIRED_MPS, crossing_limit(known))
        off_rad = wrap_angle(math.atan2(wanted[1], wanted[0]) - heading)
        w_radps = max(-W_RADPS, min(W_RADPS, GAIN_PER_S * off_rad))
        return Command(speed * max(math.cos(off_rad), 0.0), w_radps)


def force(known: Privileged, velocity: Floats) -> Floats:
    """The acceleration (2,) m/s2 of a robot that drives at `velocity` (2,)."""
    here = known.robot.pose.xy
    ahead = known.route.at(min(known.route_s_m + LOOK_M, known.route.length_m)).xy - here
    direction = ahead / max(math.hypot(*ahead), 1e-9)
    pull = (DESIRED_MPS * direction - velocity) / RELAXATION_S
    total: Floats = pull + seen(from_people(known.people, here), direction).sum(axis=0) + from_edge(known, here)
    return total


def from_people(people: People, here: Floats) -> Floats:
    """(N, 2) m/s2: the push of each person.

    The potential V0 exp(-b / sigma) falls with the semi-minor axis b of the ellipse whose foci are the person and
    where the next step leads it; 2 b = sqrt((|r| + |r - s|)^2 - |s|^2), s the step. The push is minus the gradient.
    """
    away = here - people.xy
    step = STEP_AHEAD_S * people.speed[:, None] * np.column_stack([np.cos(people.heading), np.sin(people.heading)])
    from_step = away - step
    r, q = np.hypot(away[:, 0], away[:, 1]), np.hypot(from_step[:, 0], from_step[:, 1])
    both = r + q
    b = 0.5 * np.sqrt(np.maximum(both**2 - (step**2).sum(axis=1), 1e-6))
    slope = both / (4.0 * b)
    outward = away / np.maximum(r, 1e-9)[:, None] + from_step / np.maximum(q, 1e-9)[:, None]
    strength = PEOPLE_M2PS2 / PEOPLE_M * np.exp(-b / PEOPLE_M) * slope * (r < NEAR_M)
    pushes: Floats = strength[:, None] * outward
    return pushes


def seen(pushes: Floats, direction: Floats) -> Floats:
    """Pushes (N, 2), weaker for what happens outside the view; w(e, f) of the paper."""
    ahead = -pushes @ direction >= np.hypot(pushes[:, 0], pushes[:, 1]) * math.cos(HALF_VIEW_RAD)
    weighed: Floats = pushes * np.where(ahead, 1.0, UNSEEN)[:, None]
    return weighed


def from_edge(known: Privileged, here: Floats) -> Floats:
    """(2,) m/s2: the push of the nearest edge of the free area; back inside from beyond it."""
    point = shapely.Point(here)
    edge = known.free.boundary
    nearest = np.asarray(edge.interpolate(edge.project(point)).coords[0])
    away = here - nearest
    distance_m = max(math.hypot(*away), 1e-6)
    inward = away / distance_m if shapely.contains_xy(known.free, *here) else -away / distance_m
    inside_m = distance_m if shapely.contains_xy(known.free, *here) else 0.0
    push: Floats = EDGES_M2PS2 / EDGES_M * math.exp(-(inside_m + 0.25) / EDGES_M) * inward
    return push
