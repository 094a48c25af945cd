"""Rewards of an episode from the referee's failures and the progress along the route.

A reward is the sum of these parts:

| part               | value     | when                                                      |
|--------------------|-----------|-----------------------------------------------------------|
| progress           | 1 per m   | the robot drives beyond the farthest point reached so far |
| time               | -0.2 per s | always                                                   |
| failure            | -20       | a collision, out of lane, fall or freezing                |
| red light          | -10       | a crossing is entered at red                              |
| success            | +10       | the episode ends as a success                             |
| no success         | -20       | it ends otherwise, and without a failure                  |

How a policy could gain without driving well, and why it does not:

- Driving to and fro, or in circles: only a new farthest point counts, and a reset moves it.
- Failing early to save time: a failure costs as much as 100 s.
- Waiting for the end: a timeout costs as much as a failure.
- Cutting corners or obstacles: leaving the walkable ground and contacts are failures.
- Ignoring people, or stopping for all: a broken rule or bypassed event is no success.
- Standing in people's way: contacts at a person's fault are no failures, and cost only time. The
  referee accepts this too.
- Driving close to people, or fast past them: it costs nothing, as in the success rate.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats
from cosim.results.log import Log
from cosim.results.record import Record

TIME_PER_S: Final = -0.2
"""Reward of a second."""
FAILURE: Final = -20.0
"""Reward of a failure, and of an end without success and failure."""
RED_LIGHT: Final = -10.0
"""Reward of entering a crossing at red."""
SUCCESS: Final = 10.0
"""Reward of a success."""


def tick_rewards(record: Record, log: Log) -> Floats:
    """Return the reward of each tick (T,)."""
    found = TIME_PER_S * log.tick_s + new_progress_m(log.route_s_m, log.reset_s_m)
    for failure in record.failures:
        found[failure.tick] += FAILURE
    for entry in record.red_light_entries:
        found[entry.tick] += RED_LIGHT
    if record.measures["success"] == 1.0:
        found[-1] += SUCCESS
    elif not record.failures:
        found[_missed_at(record, log)] += FAILURE
    return found


def new_progress_m(route_s_m: Floats, reset_s_m: Floats) -> Floats:
    """Return by how much each tick drove beyond the farthest arc length before it, metres (T,).

    A reset beyond that arc length moves it, and is no progress.

    route_s_m: (T,) arc length at the end of each tick, metres; it begins at 0
    reset_s_m: (T,) arc length after a reset, NaN without one

    >>> new_progress_m(np.array([1.0, 3.0, 2.0, 6.0]), np.array([np.nan, np.nan, 5.0, np.nan]))
    array([1., 2., 0., 1.])
    """
    after_m = np.fmax(route_s_m, reset_s_m)
    before_m = np.maximum.accumulate(np.concatenate([[0.0], after_m[:-1]]))
    return np.maximum(route_s_m - before_m, 0.0)


def row_rewards(record: Record, log: Log, ticks: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the rewards (n, 1) from each picture to the next one, or to the end.

    ticks: (n,) ticks of the pictures, ascending
    """
    return np.add.reduceat(tick_rewards(record, log), ticks)[:, None].astype(np.float32)


def _missed_at(record: Record, log: Log) -> int:
    """Return the tick that makes an episode without failures unsuccessful.

    It is the one at which people were passed against a rule; else the last one.
    """
    broken = [
        log.tick_at(one.passed_at_s) - 1  # the window ends before that tick
        for one in record.events
        if one.rule_met is False and one.passed_at_s is not None
    ]
    return min([*broken, len(log) - 1])
