"""Build scenarios from files of user scenarios.

The same file, map and versions give the same scenarios, with the same hashes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from cosim.core.errors import CosimError, MachineError, MapError, SpecError
from cosim.core.progress import Progress, ignore
from cosim.spec.robot import robot_called
from cosim.spec.scenario import City, CityMap, Light, Place, Scenario, Suite
from cosim.spec.spec_file import join_faults
from cosim.spec.weather import CLEAR
from scenarios.places.nets import place
from scenarios.suites.obstacles import with_obstacles
from scenarios.suites.reactive import NO_CROWD
from scenarios.suites.user_scenarios.along_route import event_along, obstacle_along
from scenarios.suites.user_scenarios.format import OwnCrowd, OwnLimits, OwnPlace, OwnScenario
from scenarios.suites.user_scenarios.read import OwnFile, Variant
from scenarios.suites.user_scenarios.routes import build_way
from sumo_nets.maps.place_names import imported_place, resolve_place

_MAKING: Final = "making the scenarios"
_VERSION: Final = "own"
_UNNAMED: Final = "scenario 'own': "
"""Prefix of messages about a scenario without a name."""
_SLOWEST_MPS = 0.2
_MIN_S = 60.0
"""Speed for the default time limit: one minute plus the time for the route at this speed."""


class BuiltScenario(NamedTuple):
    """Scenario of a file with its faults, such as "events[0]: ...", one message each.

    scenario: without the parts that do not fit; None if no route exists.
    """

    variant: Variant
    scenario: Scenario | None
    faults: tuple[str, ...]


class _Street(NamedTuple):
    """Scenario without its crowd and its light, with its faults as in `BuiltScenario`."""

    scenario: Scenario | None
    faults: tuple[str, ...]


def build_scenarios(file: OwnFile, progress: Progress = ignore) -> Iterator[BuiltScenario]:
    """Yield each scenario of a file with its faults.

    Raises MachineError if the machine lacks a requirement.
    """
    for number, variant in enumerate(file.variants):
        progress(f"{_MAKING} of {file.path.name}", number / len(file.variants))
        yield build_scenario(variant, file.name)


def build_scenario(variant: Variant, suite: str) -> BuiltScenario:
    """Build one scenario of a file, with its faults. suite: name of the suite of the file."""
    own = variant.own
    defaults = {
        "name": "own",
        "goal_protocol": None,
        "crowd": OwnCrowd(),
        "light": Light(),
        "weather": CLEAR,
        "limits": OwnLimits(),
    }
    street, faults = _street(msgspec.structs.replace(own, **defaults))
    if street is None:
        return BuiltScenario(variant, None, faults)
    limits = own.limits
    time_s = limits.time_s or round(_MIN_S + street.route_line.length_m / _SLOWEST_MPS, 1)
    try:
        scenario = msgspec.structs.replace(
            street,
            id=variant.id,
            suite=suite,
            crowd=own.crowd.spec,
            light=own.light,
            weather=own.weather,
            goal_radius_m=limits.goal_radius_m,
            time_limit_s=time_s,
            ends_on_failure=limits.ends_on_failure,
            ends_at=limits.ends_at,
        )
    except SpecError as error:
        return BuiltScenario(variant, street, (*faults, str(error)))
    return BuiltScenario(variant, scenario, faults)


def suite_of_own(file: OwnFile, progress: Progress = ignore) -> Suite:
    """Build the suite of all scenarios of a file. Raises SpecError with all faults."""
    return suite_of(file, list(build_scenarios(file, progress)))


def suite_of(file: OwnFile, made: Sequence[BuiltScenario]) -> Suite:
    """Join the scenarios of a file as a suite. Raises SpecError with all their faults."""
    if faults := dict.fromkeys(fault for one in made for fault in one.faults):
        raise SpecError(f"{file.path}: {join_faults(list(faults), len(faults))}")
    scenarios = tuple(one.scenario for one in made if one.scenario is not None)
    return Suite(
        name=file.name, version=_VERSION, scenarios=scenarios, description=file.description
    )


def place_of_own(own: OwnPlace) -> Place:
    """Return the place of a file. The file of a map is imported at its first use.

    Raises UsageError, MapError.
    """
    if own.city is not None:
        return City(seed=own.city, size_m=own.size_m, style=own.style, roughness=own.roughness)
    if own.map:
        return CityMap(map=own.map, roughness=own.roughness)
    path = Path(own.file)
    if not path.exists():
        raise SpecError(
            f"place.file: there is no {path}: give its path from the folder of this file"
        )
    try:
        if path.is_file() and not path.name.endswith((".net.xml", ".net.xml.gz")):
            return CityMap(map=imported_place(path), roughness=own.roughness)
        return resolve_place(own.file, own.roughness)
    except MapError as error:
        raise MapError(f"place.file: {error}") from error


@lru_cache(maxsize=1024)
def _street(own: OwnScenario) -> _Street:
    try:
        where, robot = _place(own.place), robot_called(own.robot)
        _, street_map = place(where)
        bare = build_way(own.way, where, street_map, own.seed, robot)
    except MachineError:
        raise
    except CosimError as error:
        return _Street(None, tuple(str(error).replace(_UNNAMED, "").split("\n")))
    faults: list[str] = []
    events = []
    placed = []
    for number, event in enumerate(own.events):
        try:
            events.append(event_along(number, event, bare, street_map, robot))
        except SpecError as error:
            faults.append(f"events[{number}]: {error}")
    for number, thing in enumerate(own.obstacles.placed):
        try:
            placed.append(obstacle_along(thing, bare.route_line))
        except SpecError as error:
            faults.append(f"obstacles.placed[{number}]: {error}")
    parts = {"events": tuple(events), "obstacles": tuple(placed)}
    scenario = msgspec.structs.replace(bare, **parts, crowd=NO_CROWD, light=Light(), ends_at="goal")
    if own.obstacles.per_100m and not faults:
        scenario = with_obstacles(
            scenario, street_map, per_100m=own.obstacles.per_100m, beside=own.obstacles.beside
        )
    return _Street(scenario, tuple(faults))


_place = lru_cache(maxsize=64)(place_of_own)
