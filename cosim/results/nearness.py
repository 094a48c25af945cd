"""How near people are at the end of a tick: in metres, and in time."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cosim.core.geometry import Floats, box_disk_gap
from cosim.core.state import PERSON_RADIUS_M, People, RobotState

_SLOWEST_MPS: Final = 1e-9


class Nearness(NamedTuple):
    """Of all people the least, inf where there is none. person_m: between centres; clearance_m:
    from the robot's outline to a person's disk, not below 0; collision_in_s: until they meet if
    both keep their velocities, inf if they never do."""

    person_m: float = np.inf
    clearance_m: float = np.inf
    collision_in_s: float = np.inf


def nearness(robot: RobotState, people: People, footprint_m: tuple[float, float]) -> Nearness:
    """How near people are to a robot of this length and width."""
    if not len(people):
        return Nearness()
    to = people.xy - robot.pose.xy
    away_m = np.hypot(to[:, 0], to[:, 1])
    least_m = float(away_m.min())
    # A gap is at most the distance of the centres, and less than it by at most half the robot's
    # diagonal.
    close = people.xy[away_m <= least_m + 0.5 * np.hypot(*footprint_m)]
    half_length_m, half_width_m = 0.5 * footprint_m[0], 0.5 * footprint_m[1]
    gap_m = float(
        box_disk_gap(np.array([robot.pose]), half_length_m, half_width_m, close[None]).min()
    )
    heading = robot.pose.heading_rad
    v_mps = robot.v_mps
    going = people.speed[:, None] * np.column_stack(
        [np.cos(people.heading), np.sin(people.heading)]
    )
    closing = going - v_mps * np.array([np.cos(heading), np.sin(heading)])
    in_s = time_to_collision_s(to, closing, half_length_m + PERSON_RADIUS_M)
    return Nearness(least_m, max(gap_m - PERSON_RADIUS_M, 0.0), float(in_s.min()))


def time_to_collision_s(offset: Floats, velocity: Floats, radius_m: float) -> Floats:
    """(N,) seconds until points that are at (N, 2) metres and move by (N, 2) m/s come within a
    radius; 0 for those that are there, inf for those that never come."""
    speed2 = (velocity**2).sum(axis=1)
    along = (offset * velocity).sum(axis=1)
    outside = (offset**2).sum(axis=1) - radius_m**2
    root2 = along**2 - speed2 * outside
    meets = (along < -_SLOWEST_MPS) & (root2 >= 0.0)
    in_s = np.full(len(offset), np.inf)
    in_s[meets] = outside[meets] / (np.sqrt(root2[meets]) - along[meets])
    in_s[outside <= 0.0] = 0.0
    return in_s
