"""Gaps that people keep to those ahead.

SUMO's people follow at a fixed gap. Here each person has its own, and stands closer where it is
held up or in a crowd. With wide gaps, people in crowds could not step aside, and would lock.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from cosim.core.geometry import headings_from_sumo
from sumo_nets.crowd.separation import pairs_within
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

    def keep(self, near: NearPersons) -> None:
        """Update the gaps. near: the persons in the simulation near the robot."""
        here = [name for name in near.names if name in self._gaps_m]
        if len(self._gaps_m) > 2 * len(here):
            self._gaps_m = {name: self._gaps_m[name] for name in here}
            self._share = {name: self._share[name] for name in here if name in self._share}
        pairs = pairs_within(near.xy, CROWDED_M)
        others = np.bincount(pairs.ravel(), minlength=len(near.names))
        shares = np.where(
            others >= CROWDED, _IN_CROWD, np.where(near.mps < HELD_UP_MPS, _HELD_UP, 1.0)
        )
        for row, (name, share) in enumerate(zip(near.names, shares.tolist(), strict=True)):
            now = self._share.get(name, 1.0)
            if share == now or name not in self._gaps_m:
                continue
            gap_m = CLOSEST_M + share * (self._gaps_m[name] - CLOSEST_M)
            if share < now or self._has_room(near, row, gap_m):
                self._share[name] = share
                self._engine.person.setMinGap(name, gap_m)

    def _has_room(self, near: NearPersons, row: int, gap_m: float) -> bool:
        """Return whether nobody is within a gap ahead of a person."""
        heading = float(headings_from_sumo(self._engine.person.getAngle(near.names[row])))
        cos, sin = math.cos(heading), math.sin(heading)
        offset = near.xy - near.xy[row]
        ahead = cos * offset[:, 0] + sin * offset[:, 1]
        aside = np.abs(cos * offset[:, 1] - sin * offset[:, 0])
        need_m = _LENGTH_M + gap_m + _SPARE_M
        return not bool(((ahead > 1e-6) & (ahead < need_m) & (aside < _ASIDE_M)).any())
