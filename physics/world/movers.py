"""Where people and vehicles are between two snapshots of the street."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.core.geometry import Floats, wrap_angles
from cosim.core.state import People, Vehicles

_JUMP_M: Final = 5.0
"""A longer way within one tick is a jump: the thing is at its new place at once."""


@dataclass(frozen=True, slots=True)
class Movers:
    """Things that move evenly during a tick. start, change: (N, 3) x, y, heading, and what is added until its end."""

    ids: tuple[str, ...]
    start: Floats
    change: Floats

    @classmethod
    def between(cls, before: People | Vehicles, after: People | Vehicles) -> Movers:
        """What `after` holds; a thing that `before` lacks is at its new place at once."""
        end = np.column_stack([after.xy, after.heading])
        start = end.copy()
        if before.ids == after.ids:
            start[:, :2], start[:, 2] = before.xy, before.heading
        else:
            row = {name: i for i, name in enumerate(before.ids)}
            pairs = [(i, row[name]) for i, name in enumerate(after.ids) if name in row]
            for i, j in pairs:
                start[i] = *before.xy[j], before.heading[j]
        change = end - start
        change[:, 2] = wrap_angles(change[:, 2])
        jumped = np.hypot(change[:, 0], change[:, 1]) > _JUMP_M
        start[jumped], change[jumped] = end[jumped], 0.0
        return cls(after.ids, start, change)

    def near(self, x_m: float, y_m: float, reach_m: Floats | float) -> Movers:
        """Those that come within `reach_m` (one, or (N,)) of a point, at the start or at the end."""
        offset = self.start[:, :2] - (x_m, y_m)
        later = offset + self.change[:, :2]
        gap = np.minimum(np.hypot(offset[:, 0], offset[:, 1]), np.hypot(later[:, 0], later[:, 1]))
        return self.only(np.flatnonzero(gap <= reach_m))

    def only(self, rows: np.ndarray[tuple[int], np.dtype[np.intp]]) -> Movers:
        return Movers(tuple(self.ids[i] for i in rows), self.start[rows], self.change[rows])

    def poses(self, substeps: int) -> Floats:
        """(S, N, 3) x, y, heading after each substep."""
        share = (np.arange(1, substeps + 1) / substeps)[:, None, None]
        return self.start + share * self.change

    def __len__(self) -> int:
        return len(self.ids)
