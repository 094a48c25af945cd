"""Groups: who enters the street together, how old they are, how fast they walk, how they stand
beside each other.

Sources. Sizes, speeds, places: Moussaid, Perozo, Garnier, Helbing, Theraulaz, The walking behaviour
of pedestrian social groups and its impact on crowd dynamics, PLoS ONE 5(4): e10047, 2010: up to 70
% of people walk in groups, side by side about 0.8 m apart, and each further member costs 0.04 m/s
(at low density). Ages: Gates, Noyce, Bill, Van Ee, Recommended walking speeds for timing of
pedestrian clearance intervals, Transp. Res. Rec. 1982, 2006: people over 65 walk 1.16 m/s on the
mean, 0.92 m/s at the 15th percentile, and children with adults like them.
"""

from __future__ import annotations

from bisect import bisect
from typing import Final, NamedTuple

import numpy as np

from cosim.core.state import Age
from cosim.spec.scenario import CrowdSpec

PERSON_MPS: Final = (1.1, 1.65)
SLOWEST_GROUP_MPS: Final = (0.8, 1.1)
"""Elderly people and children with their adults: those of them who walk outside PERSON_MPS."""

SLOWER_MPS: Final = 0.04
"""How much slower a group walks for each further member, but not below the slowest of its kind."""

TRIO_SHARE: Final = 0.25
"""Of groups, how many are of three. Moussaid's counts fall with the size as a Poisson distribution
does."""

GROUP_STRIPE_M: Final = 0.64
"""How far beside each other people walk: a stripe of SUMO's. On narrower ways some walk behind,
ROW_M."""

ROW_M: Final = 0.8


CHILDREN_SHARE = 0.10
ELDERLY_SHARE = 0.12
"""Of those whose ages nobody asked for."""

_ANY_AGES: Final = (1.0 - CHILDREN_SHARE - ELDERLY_SHARE, 1.0 - ELDERLY_SHARE)
"""Up to where draws from 0 to 1 are adults, and children."""


class PersonGroup(NamedTuple):
    """Those who enter together, one or more. ages: of each."""

    ages: tuple[Age, ...]
    pace_mps: tuple[float, float] = PERSON_MPS

    @property
    def size(self) -> int:
        return len(self.ages)

    def walks_at(self, drawn_mps: float) -> float:
        """Its speed, if somebody alone would walk at `drawn_mps`."""
        return max(drawn_mps - SLOWER_MPS * (self.size - 1), self.pace_mps[0])

    def abreast(self, width_m: float) -> int:
        """How many of it walk beside each other on a way so wide."""
        return max(min(self.size, int(width_m / GROUP_STRIPE_M + 1e-6)), 1)

    def places(self, width_m: float) -> list[tuple[float, float]]:
        """How far to the left of its middle, and how far behind its front, each walks on a way so
        wide, in metres."""
        abreast = self.abreast(width_m)
        rows = [min(abreast, self.size - first) for first in range(0, self.size, abreast)]
        return [
            (GROUP_STRIPE_M * (k - (n - 1) / 2), ROW_M * row)
            for row, n in enumerate(rows)
            for k in range(n)
        ]


class GroupDraws:
    """Draws who comes next, so that in the long run the shares of persons are those of the spec.

    Half of the children's families are children: one of two; one or two of three. coming: who
    enters next; it stays the same until it has entered, or big groups, which find room less often,
    would be too few.
    """

    def __init__(self, spec: CrowdSpec, rng: np.random.Generator) -> None:
        self._rng = rng
        self._rng_ages = rng.spawn(1)[0]
        self._ages = spec.elderly > 0.0 or spec.children > 0.0
        mean_size = 2.0 + TRIO_SHARE
        self._grouped = spec.groups / (spec.groups + (1.0 - spec.groups) * mean_size)
        self._family = 2.0 * spec.children / spec.groups if spec.groups else 0.0
        others = 1.0 - 2.0 * spec.children
        self._elder = spec.elderly / others if others > 0.0 else 0.0
        self.plain = not (spec.groups or self._ages)
        self.coming = self._draw()

    def entered(self) -> None:
        """Who was coming is there: the next, please."""
        self.coming = self._draw()

    def _draw(self) -> PersonGroup:
        if self.plain:
            return PersonGroup(self._any_ages(1))
        grouped, trio, family, second, elder = self._rng.random(5).tolist()
        size = 1 if grouped >= self._grouped else 3 if trio < TRIO_SHARE else 2
        if not self._ages:
            return PersonGroup(self._any_ages(size))
        if size > 1 and family < self._family:
            children = size - 1 if second < 0.5 else 1
            return PersonGroup(
                (Age.ADULT,) * (size - children) + (Age.CHILD,) * children, SLOWEST_GROUP_MPS
            )
        if elder < self._elder:
            return PersonGroup((Age.ELDERLY,) * size, SLOWEST_GROUP_MPS)
        return PersonGroup((Age.ADULT,) * size)

    def _any_ages(self, size: int) -> tuple[Age, ...]:
        """How old they look where the spec asks for no ages; all walk alike."""
        return tuple(
            [Age(bisect(_ANY_AGES, draw)) for draw in self._rng_ages.random(size).tolist()]
        )
