"""Group sampling: sizes, ages, speeds and formations of the groups that enter the street.

Sources. Sizes, speeds and formations: Moussaid, Perozo, Garnier, Helbing, Theraulaz, The walking
behaviour of pedestrian social groups and its impact on crowd dynamics, PLoS ONE 5(4): e10047, 2010.
Up to 70 % of people walk in groups, side by side about 0.8 m apart. Each further member costs 0.04
m/s at low density. Ages: Gates, Noyce, Bill, Van Ee, Recommended walking speeds for timing of
pedestrian clearance intervals, Transp. Res. Rec. 1982, 2006. People over 65 walk 1.16 m/s on
average, 0.92 m/s at the 15th percentile; adults with children are similar.
"""

from __future__ import annotations

from bisect import bisect
from typing import Final, NamedTuple

import numpy as np

from cosim.core.state import Age
from cosim.spec.scenario import CrowdSpec

PERSON_MPS: Final = (1.1, 1.65)
"""Range of walking speeds of adults, m/s."""
SLOWEST_GROUP_MPS: Final = (0.8, 1.1)
"""Range of walking speeds of elderly people and of adults with children, m/s."""

SLOWER_MPS: Final = 0.04
"""Speed reduction of a group per further member, m/s, limited by the slowest speed of its kind."""

TRIO_SHARE: Final = 0.25
"""Share of groups with three members; Moussaid's group sizes follow a Poisson distribution."""

GROUP_STRIPE_M: Final = 0.64
"""Lateral spacing of a group, metres: one SUMO stripe. On narrow ways members form several rows."""

ROW_M: Final = 0.8
"""Distance between the rows of a group, metres."""

GAP_M: Final = (0.3, 1.5)
"""Range of the gaps that single walkers keep to people ahead, from front to back, metres. SUMO's
people are 0.215 m long, so middles are 0.5 to 1.7 m apart."""
GROUP_GAP_M: Final = (0.3, 0.55)
"""Range of the gaps of a group's members, metres: less than the distance between rows."""


CHILDREN_SHARE = 0.10
"""Share of children where the spec sets no ages."""
ELDERLY_SHARE = 0.12
"""Share of elderly people where the spec sets no ages."""


class PersonGroup(NamedTuple):
    """One or more persons that enter together, with their ages."""

    ages: tuple[Age, ...]
    pace_mps: tuple[float, float] = PERSON_MPS

    @property
    def size(self) -> int:
        return len(self.ages)

    def speed_at(self, drawn_mps: float) -> float:
        """Return the group's speed if a single person would walk at `drawn_mps`."""
        return max(drawn_mps - SLOWER_MPS * (self.size - 1), self.pace_mps[0])

    def abreast(self, width_m: float) -> int:
        """Return how many members walk side by side on a way of this width."""
        return max(min(self.size, int(width_m / GROUP_STRIPE_M + 1e-6)), 1)

    def places(self, width_m: float) -> list[tuple[float, float]]:
        """Return each member's offset to the left of the group's middle and behind its front,
        metres."""
        abreast = self.abreast(width_m)
        rows = [min(abreast, self.size - first) for first in range(0, self.size, abreast)]
        return [
            (GROUP_STRIPE_M * (k - (n - 1) / 2), ROW_M * row)
            for row, n in enumerate(rows)
            for k in range(n)
        ]

    def gaps_m(self, rng: np.random.Generator) -> list[float]:
        """Draw the gap of each member to people ahead, metres."""
        low_m, high_m = GAP_M if self.size == 1 else GROUP_GAP_M
        gaps_m: list[float] = rng.uniform(low_m, high_m, self.size).tolist()
        return gaps_m


class GroupDraws:
    """Random sequence of groups whose long-run shares of persons match the spec.

    Half of the members of families are children: one of two, one or two of three.

    children: factor of the share of children where the spec sets no ages
    coming: the next group. It stays the same until it has entered; otherwise large groups, which
        find room less often, would be too rare.
    """

    def __init__(self, spec: CrowdSpec, rng: np.random.Generator, children: float = 1.0) -> None:
        self._rng = rng
        # Upper limits of a uniform draw for adults and for children.
        self._any_limits = (1.0 - children * CHILDREN_SHARE - ELDERLY_SHARE, 1.0 - ELDERLY_SHARE)
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
        """Draw the next group."""
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
        """Draw ages where the spec sets none; they do not affect walking."""
        return tuple(
            [Age(bisect(self._any_limits, draw)) for draw in self._rng_ages.random(size).tolist()]
        )
