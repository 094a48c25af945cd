"""Searches the gains of the quadruped's trot.

Run it with `python -m scenarios.tools.bench.search_trot EVALUATIONS SEED`. It prints every better
set of numbers. The best one is written by hand into `physics.dynamics.legs.trot`.
"""

from __future__ import annotations

import sys
from typing import Final

import numpy as np

from cosim.core.geometry import Pose
from cosim.spec.robot import DOG, Legs
from physics.dynamics.drive import SUBSTEP_S
from physics.dynamics.legs.leg_drive import LegDrive
from physics.dynamics.legs.trot import GAINS, Trot, TrotGains
from scenarios.tools.bench.legs import (
    FLAT,
    RAMPS,
    STEPS,
    down_curb,
    straight,
    up_curb,
    walking,
    wander,
)

_SPREAD: Final = TrotGains(
    half_period_s=0.015,
    height_m=0.0,
    lift_m=0.012,
    catch_s=0.012,
    level=0.12,
    v_start_mps=0.02,
    v_factor=0.04,
    v_share=0.15,
    v_gain_hz=0.3,
    w_factor=0.08,
    w_share=0.15,
    w_gain_hz=0.8,
    y_share=0.15,
    y_gain_hz=0.3,
    aside_m=0.01,
    ahead_m=0.01,
    sink_m=0.006,
    shake_mps=0.0,
    shake_rad=0.0,
)
"""Standard deviations of the first tries; 0 for numbers that are chosen, not searched."""
_SHRINKS: Final = 0.97
_MINUTES: Final = 0.6


def cost(gains: TrotGains, enough: float = np.inf) -> float:
    """Return the cost of a trot; the simulation stops where it exceeds `enough`.

    It sums errors of speed and yaw rate, distance from the line, shaking, and 1 for each fall.
    """
    legs = DOG.drive
    assert isinstance(legs, Legs)

    def drive() -> LegDrive:
        return LegDrive(DOG, legs, SUBSTEP_S, Trot(DOG, legs, SUBSTEP_S, gains))

    total = 0.0
    for seed, course in enumerate((FLAT, RAMPS, STEPS)):
        with walking(DOG, course, Pose(-40.0, 0.0, 0.0), drive()) as walk:
            found = wander(walk, DOG, _MINUTES, seed)
        total += found.fallen + 0.02 * found.jitter_deg
        total += found.error_mps + found.error_radps + found.sway_mps + 0.5 * found.sway_radps
        if total > enough:
            return total
    with walking(DOG, FLAT, Pose(-40.0, 0.0, 0.0), drive()) as walk:
        total += straight(walk, 1.0).aside_m
    for v_mps, start_m in ((0.5, 1.0), (1.0, 1.03), (1.0, 1.09), (1.4, 1.2)):
        total += down_curb(DOG, v_mps, start_m, drive())
        if total > enough:
            return total
    for v_mps, height_m in ((0.5, 0.06), (1.0, 0.06), (1.0, 0.12), (0.5, 0.12)):
        robot, fallen = up_curb(DOG, v_mps, height_m, drive())
        total += fallen + (0.1 if robot.pose.x_m < 0.5 and height_m < 0.1 else 0.0)
    return total


def search(evaluations: int, seed: int) -> TrotGains:
    """Return the best numbers of a random search around the best so far."""
    draws = np.random.default_rng(seed)
    best, least = np.array(GAINS), cost(GAINS)
    spread = np.array(_SPREAD)
    print(f"{least:.4f} {GAINS}", flush=True)
    for _ in range(evaluations):
        mask = draws.random(len(best)) < 0.4
        tried = TrotGains(*(best + mask * spread * draws.standard_normal(len(best))).tolist())
        found = cost(tried, least)
        spread = spread * (_SHRINKS if found >= least else 1.1)
        spread = np.maximum(spread, 0.1 * np.array(_SPREAD))
        if found < least:
            best, least = np.array(tried), found
            print(f"{least:.4f} {tried}", flush=True)
    return TrotGains(*best.tolist())


if __name__ == "__main__":
    search(int(sys.argv[1]), int(sys.argv[2]))
