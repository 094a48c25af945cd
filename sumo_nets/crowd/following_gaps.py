"""Gaps that people keep to those ahead.

SUMO's people follow at a fixed gap. Here each person has its own, and stands closer where it is
held up or in a crowd. With wide gaps, people in crowds could not step aside, and would lock.
"""

from __future__ import annotations

from itertools import repeat
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats, headings_from_sumo
from sumo_nets.engine import NearPersons, Sumo

HELD_UP_MPS: Final = 0.5
"""Below this speed a person is held up, m/s."""
CROWDED_M: Final = 3.0
"""Distance within which a person counts others, metres."""
CROWDED: Final = 12
"""Number of others from which it is crowded: about 0.6 persons/m2 on a sidewalk."""
CLOSEST_M: Final = 0.25
"""Smallest gap, from front to back, metres: SUMO's."""
_HELD_UP: Final = 0.4
"""Share of a gap beyond CLOSEST_M that a person keeps where it is held up."""
_IN_CROWD: Final = 0.0
"""Share of a gap beyond CLOSEST_M that a person keeps in a crowd."""
_LENGTH_M: Final = 0.215
"""Length of SUMO's people, metres."""
_SPARE_M: Final = 0.3
"""Additional room ahead for which a person takes up its gap again, metres."""
_ASIDE_M: Final = 0.7
"""Half width of this room, metres."""


class FollowingGaps:
    """The gaps of all persons."""

    def __init__(self, engine: Sumo) -> None:
        self._engine = engine
        self._gaps_m: dict[str, float] = {}
        self._share: dict[str, float] = {}

    def enter(self, name: str, gap_m: float) -> None:
        """Give a new person its gap, metres."""
        self._gaps_m[name] = gap_m
        self._engine.person.setMinGap(name, gap_m)

    def update(self, near: NearPersons) -> None:
        """Update the gaps.

        near: the persons in the simulation near the robot.
        """
        here = [name for name in near.names if name in self._gaps_m]
        if len(self._gaps_m) > 2 * len(here):
            self._gaps_m = {name: self._gaps_m[name] for name in here}
            self._share = {name: self._share[name] for name in here if name in self._share}
        others = _others_within(near.xy, CROWDED_M)
        shares = np.where(
            others >= CROWDED, _IN_CROWD, np.where(near.mps < HELD_UP_MPS, _HELD_UP, 1.0)
        )
        waiting = []
        now = map(self._share.get, near.names, repeat(1.0))
        for row, (share, next_share) in enumerate(zip(now, shares.tolist(), strict=True)):
            if next_share < share and near.names[row] in self._gaps_m:
                self._set(near.names[row], next_share)
            elif next_share > share:
                waiting.append(row)
        for row in self._with_room(near, waiting, shares):
            self._set(near.names[row], float(shares[row]))

    def _set(self, name: str, share: float) -> None:
        self._share[name] = share
        self._engine.person.setMinGap(name, self._gap_m(name, share))

    def _gap_m(self, name: str, share: float) -> float:
        return CLOSEST_M + share * (self._gaps_m[name] - CLOSEST_M)

    def _with_room(self, near: NearPersons, rows: list[int], shares: Floats) -> list[int]:
        """Return the rows of the persons whose next gap is free of other persons."""
        if not rows:
            return []
        names = [near.names[row] for row in rows]
        heading = headings_from_sumo([self._engine.person.getAngle(name) for name in names])
        cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
        dx, dy = (near.xy[None] - near.xy[rows][:, None]).transpose(2, 0, 1)
        ahead = cos * dx + sin * dy
        aside = np.abs(cos * dy - sin * dx)
        gaps_m = [self._gap_m(near.names[row], float(shares[row])) for row in rows]
        need_m = _LENGTH_M + np.array(gaps_m)[:, None] + _SPARE_M
        taken = (ahead > 1e-6) & (ahead < need_m) & (aside < _ASIDE_M)
        return [row for row, full in zip(rows, taken.any(axis=1).tolist(), strict=True) if not full]


def _others_within(xy: Floats, reach_m: float) -> NDArray[np.intp]:
    """Return the number of other points within `reach_m` of each point (N, 2), as (N,)."""
    x, y = xy.T.copy()
    dx, dy = x[:, None] - x, y[:, None] - y
    dx *= dx
    dy *= dy
    dx += dy
    return np.asarray(np.count_nonzero(dx <= reach_m * reach_m, axis=1) - 1)
