"""Distance walked by a robot with legs, without the sway of its trunk."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.geometry import Floats


def walked_m(xy: Floats, reset_s_m: Floats, cycle_ticks: float) -> Floats:
    """Return the distance walked in each tick (T,), metres: between means over a gait cycle.

    xy: positions (T, 2) at the end of each tick, metres
    reset_s_m: (T,) finite after the ticks in which the robot was reset, else NaN
    cycle_ticks: duration of a gait cycle in ticks

    No mean is taken across a reset. The tick after a reset, at rest, and the first tick get 0.
    """
    walked = np.zeros(len(xy))
    ends = [*(np.flatnonzero(np.isfinite(reset_s_m)) + 1).tolist(), len(xy)]
    for begin, end in zip([0, *ends[:-1]], ends, strict=True):
        if end - begin > 1:
            steps = np.diff(_cycle_means(xy[begin:end], cycle_ticks), axis=0)
            walked[begin + 1 : end] = np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2)
    return walked


def _cycle_means(xy: Floats, cycle_ticks: float) -> Floats:
    """Return the mean position (T, 2) over a cycle around each tick.

    Beyond its ends the path is continued by its point reflection, so that both ends stay in place.
    """
    half = math.floor(0.5 * cycle_ticks + 0.5)
    outer = 0.5 * cycle_ticks + 0.5 - half
    padded = np.pad(xy, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    total = np.zeros_like(xy)
    for k in range(2 * half + 1):
        weight = outer if k in (0, 2 * half) else 1.0
        total += weight * padded[k : k + len(xy)]
    return total / (2 * half - 1 + 2 * outer)
