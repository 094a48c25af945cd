"""Count the sidewalks, crosswalks and routes of a place on which each kind of scenario fits.

The scenario builders are run a few times for each strip. A count is therefore a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Final

import msgspec
import numpy as np

from cosim.core.errors import CosimError
from cosim.place.route_line import START_M
from cosim.place.street_map import Port, StreetMap, Strip
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventKinds
from cosim.spec.robot import COURIER, Robot
from scenarios.events import EVENT_KINDS
from scenarios.suites.drawing import Refusals, first_of
from scenarios.suites.long_horizon import (
    avoided_strips,
    draw_way,
    fences_along,
    lone_route,
    search_way,
    starts,
)
from scenarios.suites.reactive import event_spot, strips_of
from scenarios.suites.unit import STRUCTURES, drawn_along, lies_on, strips_for

_DRAWS: Final = 4
"""Number of draws on each strip."""
_SIDEWALKS: Final = 1000
_SLOW: Final = 80
"""Maximum number of crosswalks and corners that are examined, evenly spread, because they are
slow.
"""
_WAYS: Final = 8
_WAY_DRAWS: Final = 120

_NO_STRIP: Final = {
    "sidewalks": "no sidewalk is wide enough, apart from stairs, bridges and tunnels",
    "crosswalks": "no crosswalk is without signals",
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


def capacity_of(
    street_map: StreetMap, graph: WalkGraph, kinds: EventKinds = EVENT_KINDS, robot: Robot = COURIER
) -> Capacity:
    """Count where each kind of scenario fits a robot on a place. Equal maps give equal counts."""
    rng = np.random.default_rng(0x0FFE)
    events: dict[str, FitCount] = {}
    structures: dict[str, FitCount] = {}
    for name, kind in kinds.items():
        strips = strips_of(kind, street_map, graph)
        slow = kind.layout is None
        spot = partial(event_spot, kind, street_map=street_map, rng=rng, robot=robot)
        events[name] = _fit_count(
            strips, "crosswalks" if slow else "sidewalks", _SLOW if slow else _SIDEWALKS, spot
        )
    for structure in STRUCTURES:
        strips = strips_for(structure, street_map, graph, robot)
        way = partial(
            drawn_along, structure, street_map=street_map, graph=graph, rng=rng, robot=robot
        )
        what = "crosswalks" if lies_on(structure) == "crossing" else "sidewalks"
        most = _SLOW
        structures[structure] = _fit_count(
            strips, what, _SIDEWALKS if structure == "straight" else most, way, _NO_STRIP[what]
        )
    return Capacity(
        events=events, structures=structures, routes=_routes(street_map, graph, rng, robot)
    )


def _fit_count(
    strips: Sequence[Strip],
    what: str,
    most: int,
    draw: Callable[[Strip], object],
    no_strip: str = "",
) -> FitCount:
    """Count the strips on which a draw succeeds; at most `most` are examined.

    no_strip: reason for an empty list of strips.
    """
    chosen = [strips[int(i)] for i in np.linspace(0, len(strips) - 1, min(most, len(strips)))]
    refusals = Refusals()
    found = sum(
        any(_fits(partial(draw, strip), refusals) for _ in range(_DRAWS)) for strip in chosen
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
            ways = list(islice(_drawn(draw, refusals), _WAYS))
            looked_at += len(ways)
            found = sum(
                _fits(partial(lone_route, street_map, way, fences_along, robot), refusals)
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
