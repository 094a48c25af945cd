"""Count the sidewalks, crosswalks and routes of a place on which each kind of scenario fits.

The scenario builders are run a few times for each strip. A count is therefore a lower bound.
On a scan they are run to the end, with all obstacles, as `cosim run --map` runs them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Final, NamedTuple

import msgspec
import numpy as np

from cosim.core.errors import CosimError
from cosim.place.route_line import START_M
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKind
from cosim.spec.robot import COURIER, Robot
from cosim.spec.scenario import CityMap, Place, Scenario
from scenarios.events import EVENT_KINDS
from scenarios.suites.drawing import SCAN_TRIES, Refusals, first_of
from scenarios.suites.long_horizon import (
    avoided_strips,
    draw_way,
    fenced_route,
    fences_along,
    search_way,
    starts,
)
from scenarios.suites.reactive import event_spot, reactive_on, strips_of
from scenarios.suites.unit import (
    STRUCTURES,
    Structure,
    drawn_along,
    lies_on,
    strips_for,
    unit_along,
)

_DRAWS: Final = 4
"""Number of draws on each strip."""
_SIDEWALKS: Final = 1000
_SLOW: Final = 80
"""Maximum number of crosswalks and corners that are examined, evenly spread, because they are
slow.
"""
_MAX_SEED: Final = 2**31 - 1
_WAYS: Final = 8
_SCAN_WAYS: Final = 40
"""Numbers of drawn ways for long routes that are examined, on nets and on scans."""
_WAY_DRAWS: Final = 120

_NO_STRIP: Final = {
    "sidewalk": "no sidewalk is wide enough, apart from stairs, bridges and tunnels",
    "crossing": "no crosswalk is without signals",
}
"""Reason that is reported if a structure has no strip."""

_Way = tuple[list[Port], float, float]


class FitCount(msgspec.Struct, frozen=True, kw_only=True):
    """Places where a scenario fits.

    found: number of places where it fits.
    places: number of places; for ways only the drawn ones.
    what: sidewalks, crosswalks or ways.
    why_not: most frequent reason if none was found, else empty.
    """

    found: int
    looked_at: int
    places: int
    what: str
    why_not: str = ""

    def __str__(self) -> str:
        if not self.places:
            return f"none: {self.why_not or 'there are no ' + self.what}"
        if not self.found:
            many = "" if self.looked_at == self.places else f" looked at, of {self.places}"
            return f"none of {self.looked_at} {self.what}{many}" + (
                f": {self.why_not}" if self.why_not else ""
            )
        if self.looked_at == self.places:
            return f"{self.found} of {self.places} {self.what}"
        return (
            f"at least {self.found}: {self.looked_at} of {self.places} {self.what} were looked at"
        )


class Capacity(msgspec.Struct, frozen=True, kw_only=True):
    """Capacity of a place: by kind of event, by structure of the unit suite, and for long
    routes.
    """

    events: dict[str, FitCount]
    structures: dict[str, FitCount]
    routes: FitCount

    @property
    def usable(self) -> bool:
        """Return whether any scenario fits."""
        return any(
            count.found for count in (*self.events.values(), *self.structures.values(), self.routes)
        )


def capacity_of(street_map: StreetMap, graph: WalkGraph) -> Capacity:
    """Count where each kind of scenario fits the courier on a place.

    Equal maps give equal counts.
    """
    robot = COURIER
    rng = np.random.default_rng(0x0FFE)
    scan_draws = _ScanDraws(street_map, graph, rng, robot) if street_map.scanned else None
    least = 1 if scan_draws is None else SCAN_TRIES
    events: dict[str, FitCount] = {}
    structures: dict[str, FitCount] = {}
    for name, kind in EVENT_KINDS.items():
        strips = strips_of(kind, street_map, graph)
        slow = kind.layout is None
        spot: Callable[[Strip], object] = (
            partial(event_spot, kind, street_map=street_map, rng=rng, robot=robot)
            if scan_draws is None
            else partial(scan_draws.event, kind)
        )
        what = "crosswalks" if slow else _sidewalks(street_map)
        events[name] = _fit_count(strips, what, _SLOW if slow else _SIDEWALKS, spot, least=least)
    for structure in STRUCTURES:
        strips = strips_for(structure, street_map, graph, robot)
        way: Callable[[Strip], object] = (
            partial(
                drawn_along, structure, street_map=street_map, graph=graph, rng=rng, robot=robot
            )
            if scan_draws is None
            else partial(scan_draws.unit, structure)
        )
        kind_of_strip = lies_on(structure)
        what = "crosswalks" if kind_of_strip == "crossing" else "sidewalks"
        if structure == "straight":
            what = _sidewalks(street_map)
        most = _SIDEWALKS if structure == "straight" else _SLOW
        structures[structure] = _fit_count(strips, what, most, way, _NO_STRIP[kind_of_strip], least)
    return Capacity(
        events=events, structures=structures, routes=_routes(street_map, graph, rng, robot)
    )


class _ScanDraws(NamedTuple):
    """Draws of scenarios on a scan, to count where they fit."""

    street_map: StreetMap
    graph: WalkGraph
    rng: np.random.Generator
    robot: Robot

    @property
    def place(self) -> Place:
        return CityMap(map=self.street_map.name)

    def event(self, kind: EventKind, strip: Strip) -> Scenario:
        """Draw a reactive scenario on a strip, with a seed of its own."""
        seed = int(self.rng.integers(_MAX_SEED))
        return reactive_on(
            strip, kind, self.place, self.street_map, self.rng, seed, kind.name, robot=self.robot
        )

    def unit(self, structure: Structure, strip: Strip) -> Scenario:
        """Draw a unit scenario on a strip, with a seed of its own."""
        seed = int(self.rng.integers(_MAX_SEED))
        route, crossings = drawn_along(
            structure, strip, self.street_map, self.graph, self.rng, self.robot
        )
        return unit_along(
            structure, route, crossings, self.place, self.street_map, seed, structure, self.robot
        )


def _sidewalks(street_map: StreetMap) -> str:
    """Return the name of what `sidewalks_of` returns."""
    return "stretches of sidewalk" if street_map.scanned else "sidewalks"


def _fit_count(
    strips: Sequence[Strip],
    what: str,
    most: int,
    draw: Callable[[Strip], object],
    no_strip: str = "",
    least: int = 1,
) -> FitCount:
    """Count the strips on which a draw succeeds; at most `most` are examined.

    no_strip: reason for an empty list of strips.
    least: number of draws on all of them together.
    """
    chosen = [strips[int(i)] for i in np.linspace(0, len(strips) - 1, min(most, len(strips)))]
    refusals = Refusals()
    draws = max(_DRAWS, math.ceil(least / max(len(chosen), 1)))
    found = sum(
        any(_fits(partial(draw, strip), refusals) for _ in range(draws)) for strip in chosen
    )
    reason = "" if found else refusals.most_frequent or no_strip
    return FitCount(
        found=found, looked_at=len(chosen), places=len(strips), what=what, why_not=reason
    )


def _routes(
    street_map: StreetMap, graph: WalkGraph, rng: np.random.Generator, robot: Robot
) -> FitCount:
    """Count the drawn ways that make a long route.

    If none does, count a few more ways that avoid roads.
    """
    refusals = Refusals()
    candidates = starts(street_map, graph)
    avoided = avoided_strips(street_map)
    usable = [strip for strip in candidates if strip not in avoided]
    found = looked_at = 0
    for some, draw in (
        (candidates, partial(draw_way, street_map, graph, rng, candidates)),
        (usable, partial(search_way, street_map, graph, rng, usable, avoided)),
    ):
        if some and not found:
            most = _SCAN_WAYS if street_map.scanned else _WAYS
            ways = list(islice(_drawn(draw, refusals), most))
            looked_at += len(ways)
            found = sum(
                _fits(partial(fenced_route, street_map, way, fences_along, robot), refusals)
                for way in ways
            )
    reason = "" if found else refusals.most_frequent or f"no sidewalk is {START_M:g} m long"
    return FitCount(
        found=found, looked_at=looked_at, places=looked_at, what="ways drawn", why_not=reason
    )


def _drawn(draw: Callable[[], _Way], refusals: Refusals) -> Iterator[_Way]:
    """Yield the ways of _WAY_DRAWS draws that are not refused."""
    for _ in range(_WAY_DRAWS):
        try:
            yield draw()
        except CosimError as refusal:
            refusals.add(refusal)


def _fits(draw: Callable[[], object], refusals: Refusals) -> bool:
    """Return whether a draw succeeds; add its refusal otherwise."""
    return first_of([draw], refusals) is not None
