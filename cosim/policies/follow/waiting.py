"""Standing for people who are near in the way: for some seconds, then it goes round who has not gone."""

from __future__ import annotations

import math
from typing import Final

from cosim.core.geometry import Floats

_NEAR_M: Final = (2.5, 0.9)
"""Ahead of the robot's middle, and to either side."""
_WAITS_S: Final = 4.0
_LOST_S: Final = 1.0
"""Who is not seen for so long is gone."""


class WaitForPeople:
    """Since when somebody is near."""

    def __init__(self) -> None:
        self._first_s = self._last_s = -math.inf

    def stands(self, time_s: float, people: Floats) -> bool:
        """Whether it stands now, with people (N, 2) seen in the robot's frame.

        >>> WaitForPeople().stands(1.0, np.array([[2.0, 0.0]]))
        True
        """
        near = (people[:, 0] > 0.0) & (people[:, 0] < _NEAR_M[0]) & (abs(people[:, 1]) < _NEAR_M[1])
        if not near.any():
            return False
        if time_s - self._last_s > _LOST_S:
            self._first_s = time_s
        self._last_s = time_s
        return time_s - self._first_s < _WAITS_S
