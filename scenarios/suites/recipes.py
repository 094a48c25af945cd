"""Recipes of the shipped suites: names and places of their scenarios, and how candidates are
drawn.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, cast, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.place.street_map import StreetMap
from cosim.place.walk_graph import WalkGraph
from cosim.spec.scenario import City, CityMap, Place, Scenario, Split
from cosim.spec.selection import STATIC
from scenarios.events import EVENT_KINDS
from scenarios.places.nets import place
from scenarios.suites.daylight import drawn_daylight
from scenarios.suites.decoys import DECOY
from scenarios.suites.drawing import passable
from scenarios.suites.long_horizon import build_long_horizon
from scenarios.suites.reactive import LIMIT_S, WAY_M, Wanted, build_reactive
from scenarios.suites.unit import STRUCTURES, Structure, build_unit
from sumo_nets.city.store import SEEDS, TEST_SEEDS
from sumo_nets.maps.import_rules import WHEEL_PLACES

LONG_WAY: Final = "route"
TEST_CROPS: Final = ("braunschweig-2", "wildau-1")
TEST_SCANS: Final = ("lund-street", "scan-12")
_SMALL_CROPS: Final = ("ingolstadt-1", "braunschweig-1")
_REAL_UNIT: Final = tuple(name for name in WHEEL_PLACES if name != "berlin-7")
"""Ten real places with straight ways and corners."""
_REAL_CROSSWALKS: Final = (*(name for name in WHEEL_PLACES if name not in _SMALL_CROPS), "berlin-3")
"""Places of ten crosswalks. The largest place has two, since small places have none without
signals.
"""
_REAL_ROUTES: Final = {
    "berlin-1": 150.0,
    "berlin-3": 200.0,
    "berlin-4": 250.0,
    "berlin-6": 300.0,
    "braunschweig-2": 350.0,
}
ALL_ROUTES_M: Final = 36_500.0
SCANS_ROUTE_M: Final = (60.0, 150.0)
"""Shortest and longest route of `scans`, in metres."""
_SCANS: Final[Mapping[str, tuple[int, int, int, float]]] = MappingProxyType(
    {
        "scan-5": (10, 8, 1, 145.0),
        "scan-12": (6, 12, 4, 110.0),
        "scan-40": (22, 10, 5, 130.0),
        "lund-street": (22, 0, 0, 90.0),
        "autzen-boulevard": (10, 0, 0, 72.0),
    }
)
"""Places of `scans`: numbers of scenarios of each structure, and the length of the route in metres.
The real places have neither corners between sidewalks nor crossings shorter than 17 m.
"""
_SHORTEST_M: Final = 120.0
_DIGITS: Final = 4
_REDRAW_SEEDS: Final = 1_000_000
"""Number of seeds of each redraw of a suite. About 4,000 redraws fit into the range of seeds."""


@dataclass(frozen=True, kw_only=True)
class Slot:
    """Recipe of one scenario.

    structure: see `Scenario`.
    number: seed of its first candidate.
    length_m: length of a route.
    like: name of the slot whose scenario it repeats without its events.
    decoy_of: name of the slot with whose scenario its own is drawn and proved.
    wanted: what is drawn before the place of a reactive scenario.
    redraw: number of the draw; 0 is that of the shipped suite.
    """

    name: str
    suite: str
    structure: str
    where: Place
    split: Split
    number: int
    length_m: float = 0.0
    like: str = ""
    decoy_of: str = ""
    wanted: Wanted | None = None
    redraw: int = 0

    def seed(self, attempt: int) -> int:
        """Return the seed of a candidate."""
        return _REDRAW_SEEDS * self.redraw + 1000 * attempt + self.number


@dataclass(frozen=True, kw_only=True)
class SuiteRecipe:
    """Recipe of a suite. purpose: short description; slots: recipes of its scenarios, in order."""

    version: str
    description: str
    purpose: str
    slots: Sequence[Slot] = field(repr=False)
    draw: Callable[[Slot, StreetMap, WalkGraph, int], Scenario]


def recipe_of(name: str, redraw: int = 0) -> SuiteRecipe:
    """Return the recipe of a suite, or that of a redraw with other seeds.

    redraw: its number, at most 4000; 0 for the shipped suite.
    """
    recipe = RECIPES[name]
    if not redraw:
        return recipe
    return replace(
        recipe,
        version=f"{recipe.version}-redraw-{redraw}",
        slots=[_redrawn(slot, redraw) for slot in recipe.slots],
    )


def _redrawn(slot: Slot, redraw: int) -> Slot:
    if slot.wanted is None:
        return replace(slot, redraw=redraw)
    return replace(slot, redraw=redraw, wanted=_wanted(slot.structure, redraw)[slot.where.seed])


def candidate(slot: Slot, seed: int) -> Scenario:
    """Draw a candidate for a slot from a seed. Raises CosimError if none fits its place."""
    _, street_map = place(slot.where)
    drawn = RECIPES[slot.suite].draw(slot, street_map, _graph(slot.where), seed)
    rng = np.random.default_rng([seed, zlib.crc32(slot.name.encode())])
    # Each structure has another offset, so that those of one city are not all of one hour.
    light = drawn_daylight(rng, slot.number + 5 * zlib.crc32(slot.structure.encode()) % 84)
    scenario = msgspec.structs.replace(
        drawn, suite=slot.suite, light=light, split=slot.split, structure=slot.structure
    )
    return msgspec.convert(_in_few_digits(msgspec.to_builtins(scenario)), Scenario)


def _in_few_digits(value: Any) -> Any:
    """Return a spec as plain data, with numbers rounded to measurable digits.

    This halves the size of a suite's file.
    """
    if isinstance(value, float):
        return round(value, _DIGITS)
    if isinstance(value, dict):
        return {key: _in_few_digits(item) for key, item in value.items()}
    return [_in_few_digits(item) for item in value] if isinstance(value, list | tuple) else value


def repeated(slot: Slot, of: Scenario) -> Scenario:
    """Return the scenario of a slot that repeats another one without people."""
    return msgspec.structs.replace(
        of,
        id=slot.name,
        events=(),
        structure=slot.structure,
        ends_at="goal",
        time_limit_s=LIMIT_S,
    )


@lru_cache(maxsize=1)
def _graph(where: Place) -> WalkGraph:
    return WalkGraph(place(where)[1])


def _split_of(where: Place) -> Split:
    name = where.map if isinstance(where, CityMap) else where.seed
    return "test" if name in (*TEST_CROPS, *TEST_SEEDS, *TEST_SCANS) else "val"


def _cities() -> list[tuple[int, City]]:
    return [(number, City(seed=seed)) for number, seed in enumerate(SEEDS)]


def _slot(suite: str, name: str, structure: str, where: Place, number: int, **more: Any) -> Slot:
    split = _split_of(where)
    return Slot(
        name=name, suite=suite, structure=structure, where=where, split=split, number=number, **more
    )


def _unit_slots() -> list[Slot]:
    """Return slots with each structure once in every city and ten times on real places."""
    found = []
    for number, city in _cities():
        found += [_slot("unit", f"{one}-{city.seed:03d}", one, city, number) for one in STRUCTURES]
    for structure in STRUCTURES:
        named: dict[str, int] = {}
        for crop in _REAL_CROSSWALKS if structure == "crosswalk" else _REAL_UNIT:
            named[crop] = named.get(crop, 0) + 1
            name = f"{structure}-{crop}" + (f"-{named[crop]}" if named[crop] > 1 else "")
            found.append(_slot("unit", name, structure, CityMap(map=crop), 100 * named[crop]))
    return found


def _reactive_slots() -> list[Slot]:
    """Return slots with each event and its decoy once in every city, and the first kind's place
    also without people.
    """
    reference = next(iter(EVENT_KINDS))
    wanted = {kind: _wanted(kind) for kind in EVENT_KINDS}
    found = []
    for number, city in _cities():
        for kind in EVENT_KINDS:
            name = f"{kind}-{city.seed:03d}"
            of_kind = wanted[kind][city.seed]
            one = _slot("reactive", name, kind, city, number, wanted=of_kind)
            found += [one, replace(one, name=name + DECOY, decoy_of=name)]
        like = f"{reference}-{city.seed:03d}"
        found.append(
            _slot("reactive", f"{STATIC}-{city.seed:03d}", STATIC, city, number, like=like)
        )
    return found


@lru_cache(maxsize=len(EVENT_KINDS))
def _wanted(kind: str, redraw: int = 0) -> Mapping[int, Wanted]:
    """Return what is drawn before the place, by the seed of the city.

    In each split, lengths and positions are evenly spread, and sides equally frequent. Each
    property has its own generator.
    """
    found: dict[int, Wanted] = {}
    for split in get_args(Split):
        seeds = [city.seed for _, city in _cities() if _split_of(city) == split]
        named = zlib.crc32(f"{kind} {split}".encode())
        other = (redraw,) if redraw else ()
        rngs = [np.random.default_rng([named, purpose, *other]) for purpose in range(4)]
        count = len(seeds)
        lengths_m = WAY_M[0] + (WAY_M[1] - WAY_M[0]) * _even(rngs[0].permutation(count))
        shares = _even(rngs[1].permutation(count))
        sides, free_sides = (1 - 2 * (rng.permutation(count) % 2) for rng in rngs[2:])
        for one in zip(seeds, lengths_m.tolist(), shares.tolist(), sides, free_sides, strict=True):
            seed, length_m, share, side, free_side = one
            found[seed] = Wanted(
                round(length_m, 2), share, 1 if side > 0 else -1, 1 if free_side > 0 else -1
            )
    return found


def _even(ranks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the middles of equal parts of the interval from 0 to 1, in the order of ranks."""
    return (ranks + 0.5) / len(ranks)


def _route_slots() -> list[Slot]:
    """Return slots with a route in every city. Their lengths are evenly spread and have the wanted
    sum.
    """
    cities = _cities()
    mean_m = (ALL_ROUTES_M - sum(_REAL_ROUTES.values())) / len(cities)
    lengths_m = np.linspace(_SHORTEST_M, 2.0 * mean_m - _SHORTEST_M, len(cities))
    lengths_m = np.random.default_rng(0x105).permutation(np.round(lengths_m, 1))
    found = [
        _slot(
            "long-horizon",
            f"lh-{city.seed:03d}-00",
            LONG_WAY,
            city,
            number,
            length_m=float(lengths_m[number]),
        )
        for number, city in cities
    ]
    for crop, length_m in _REAL_ROUTES.items():
        found.append(
            _slot("long-horizon", f"lh-{crop}", LONG_WAY, CityMap(map=crop), 0, length_m=length_m)
        )
    return found


def _scan_slots() -> list[Slot]:
    """Return slots with short scenarios and a route on each scan."""
    found: list[Slot] = []
    for name, (*counts, length_m) in _SCANS.items():
        where = CityMap(map=name)
        for structure, count in zip(STRUCTURES, counts, strict=True):
            for number in range(count):
                called = f"{structure}-{name}-{number:02d}"
                found.append(_slot("scans", called, structure, where, len(found)))
        called = f"{LONG_WAY}-{name}"
        found.append(_slot("scans", called, LONG_WAY, where, len(found), length_m=length_m))
    return found


def _unit(slot: Slot, street_map: StreetMap, graph: WalkGraph, seed: int) -> Scenario:
    return build_unit(
        cast(Structure, slot.structure), slot.where, street_map, graph, seed, slot.name
    )


def _reactive(slot: Slot, street_map: StreetMap, graph: WalkGraph, seed: int) -> Scenario:
    return build_reactive(
        EVENT_KINDS[slot.structure],
        slot.where,
        street_map,
        graph,
        seed,
        slot.name,
        wanted=slot.wanted,
    )


def _route(slot: Slot, street_map: StreetMap, graph: WalkGraph, seed: int) -> Scenario:
    return build_long_horizon(
        slot.where, street_map, graph, seed, slot.name, length_m=slot.length_m
    )


def _scan(slot: Slot, street_map: StreetMap, graph: WalkGraph, seed: int) -> Scenario:
    """Draw a scenario of `scans`. Its crowd is thinner where people could not pass the robot."""
    if slot.structure != LONG_WAY:
        return _unit(slot, street_map, graph, seed)
    route = build_long_horizon(
        slot.where, street_map, graph, seed, slot.name, length_m=slot.length_m, roomy=True
    )
    return passable(route, street_map)


RECIPES: Final[Mapping[str, SuiteRecipe]] = MappingProxyType(
    {
        "unit": SuiteRecipe(
            version="2.0",
            description="10 to 20 m straight on, round a corner or over a crosswalk, past things "
            "that stand there; nobody else. 100 of each in generated cities, 10 of each on real "
            "places. Ends on the first failure.",
            purpose="lane following and static obstacles",
            slots=_unit_slots(),
            draw=_unit,
        ),
        "reactive": SuiteRecipe(
            version="2.0",
            description="12 to 30 m of straight way with one event of pedestrians on it and nobody "
            "else: 100 of each event in the same cities, each with a decoy, and as reference 100 "
            "with nobody there. No straight lane is free. Ends on the first failure.",
            purpose="eight events of pedestrians, with decoys",
            slots=_reactive_slots(),
            draw=_reactive,
        ),
        "long-horizon": SuiteRecipe(
            version="2.0",
            description="105 ways of more than 100 m, 36.5 km in all, 5 of them on real places; "
            "exactly one walkable path; crowd, signals, vehicles, obstacles and events on the "
            "way. Never ends on a failure.",
            purpose="long ways through street life",
            slots=_route_slots(),
            draw=_route,
        ),
        "scans": SuiteRecipe(
            version="1.0",
            description="110 ways of 10 to 20 m past things that stand there, and 5 of 60 to "
            "150 m with crowd and events, on five scanned places: two real ones, whose files the "
            "user imports, and three generated ones. The long ones never end on a failure.",
            purpose="scanned places, with images of real streets",
            slots=_scan_slots(),
            draw=_scan,
        ),
    }
)
