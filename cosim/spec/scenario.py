"""Scenario and Suite: frozen specs of the benchmark, and their files.

A spec is complete: it determines its episode bit for bit, in any process.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, cast, get_args

import msgspec
import numpy as np

from cosim.core.errors import SpecError, unknown
from cosim.core.geometry import Polyline, Pose
from cosim.spec.events import Event, EventKinds
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import COURIER, robot_called
from cosim.spec.spec_file import join_faults, read_spec_file
from cosim.spec.validation import (
    ARC_LENGTH_M,
    COORDINATE_M,
    HEADING_RAD,
    SEED,
    ItemCount,
    PathName,
    Points,
    Ranged,
    Text,
    Within,
    shown,
)
from cosim.spec.weather import CLEAR, Weather, weather_called, weather_fault

_SCHEMA = 1
"""Version of the scenario files; other versions are refused."""
_TICKS_PER_S = 20
_SHORTEST_M = 1.0
"""Minimum length of a reference route in metres."""
_LONGEST_M = 20_000.0
"""Maximum length of a reference route in metres."""
_SLACK_M = 0.01
"""Tolerance of arc lengths at the end of the route, in metres."""
EVENT_BEYOND_M = 60.0
"""Maximum distance of an event beyond the goal in metres; oncoming people may start there."""
SHARE = Within(0, 1, words="must be a share in {range}, not {value}")
"""Range of a share."""
_NAME = Text(200)
FOLDER = PathName("a folder")


_ROUGHNESS = Within(0, 1, words="is {value:g}, but it lies between 0 (flat) and 1")
CITY_SIZE_M = Within(200, 4000)
"""Range of a city's size in metres. A smaller square has no space for two blocks."""


class City(Ranged, frozen=True, kw_only=True, tag="city", tag_field="kind"):
    """Procedural city.

    size_m: side of the square, in whole centimetres.
    net_hash: content hash of the street net of the scenario.
    roughness: roughness of the ground, from 0 (flat) to 1.
    """

    seed: Annotated[int, SEED]
    size_m: Annotated[float, CITY_SIZE_M] = 2000.0
    style: Annotated[str, PathName("a style")] = "mixed"
    net_hash: Annotated[str, _NAME] = ""
    roughness: Annotated[float, _ROUGHNESS] = 0.0

    def contradictions(self) -> Iterator[str]:
        if round(self.size_m, 2) != self.size_m:
            yield f"city size_m must be in whole centimetres, not {self.size_m}"

    @property
    def name(self) -> str:
        return f"city-{self.style}-{self.size_m:g}m-{self.seed}"


class CityMap(Ranged, frozen=True, kw_only=True, tag="map", tag_field="kind"):
    """Imported map, by its name in the map store.

    seed: seed of what the map does not contain (buildings, props).
    roughness: roughness of the ground, from 0 (flat) to 1.
    """

    map: Annotated[str, _NAME]
    seed: Annotated[int, SEED] = 0
    net_hash: Annotated[str, _NAME] = ""
    roughness: Annotated[float, _ROUGHNESS] = 0.0

    @property
    def name(self) -> str:
        return f"map-{self.map}"


Place = City | CityMap


class Barrier(Ranged, frozen=True, kw_only=True):
    """Fence across a way.

    heading_rad: direction of the way that it closes.
    length_m: length across the way.
    strip, end: port of the walking graph that it closes.
    """

    x_m: Annotated[float, COORDINATE_M]
    y_m: Annotated[float, COORDINATE_M]
    heading_rad: Annotated[float, HEADING_RAD]
    length_m: Annotated[float, Within(0.1, 200)]
    strip: Annotated[str, _NAME]
    end: Literal[0, 1]
    thickness_m: Annotated[float, Within(0.01, 2)] = 0.12
    height_m: Annotated[float, Within(0.1, 5)] = 1.0


class RouteCrossing(Ranged, frozen=True, kw_only=True):
    """Crossing on the reference route, from arc length enter_s_m to leave_s_m."""

    id: Annotated[str, _NAME]
    enter_s_m: Annotated[float, ARC_LENGTH_M]
    leave_s_m: Annotated[float, ARC_LENGTH_M]
    signalised: bool

    @property
    def prefix(self) -> str:
        return f"crossing {shown(self.id)}: "

    def contradictions(self) -> Iterator[str]:
        if self.enter_s_m > self.leave_s_m:
            yield f"{self.prefix}enter_s_m {self.enter_s_m} comes after leave_s_m {self.leave_s_m}"


DEFAULT_PERSONS = 50
"""Default number of persons around the robot."""
MAX_PERSONS = 1000
"""Maximum number of persons; SUMO would be too slow for more."""
MAX_PER_1000_M2 = 150.0
"""Maximum density in persons per 1000 m2. Denser crowds have no space to enter 1.5 m apart."""


class CrowdSpec(Ranged, frozen=True, kw_only=True):
    """Background crowd: persons and vehicles within radius_m of the robot.

    density: persons per 1000 m2 of walkable ground, in place of a number of persons.
    residents: number of residents within 60 m of the robot, in addition to the persons. They sit on
        benches, look into shop windows and wait at stops.
    groups: share of the persons who walk in groups of two and three.
    elderly, children: shares of slower walkers. A child walks with an adult, at the child's pace.
    added: whether the crowd was requested in place of the suite's own.
    """

    persons: Annotated[int, Within(0, MAX_PERSONS)] = DEFAULT_PERSONS
    radius_m: Annotated[float, Within(20, 500)] = 80.0
    vehicles: Annotated[int, Within(0, 200)] = 20
    density: Annotated[
        float | None,
        Within(0, MAX_PER_1000_M2, words="must be in {range} per 1000 m2, not {value}"),
    ] = None
    residents: Annotated[int, Within(0, 60)] = 0
    groups: Annotated[float, SHARE] = 0.0
    elderly: Annotated[float, SHARE] = 0.0
    children: Annotated[float, SHARE] = 0.0
    added: bool = False

    @property
    def prefix(self) -> str:
        return "crowd "

    @property
    def empty(self) -> bool:
        """Whether the crowd has neither persons nor vehicles; residents do not count."""
        return not self.vehicles and not (self.persons if self.density is None else self.density)

    def contradictions(self) -> Iterator[str]:
        if 2.0 * self.children > self.groups + 1e-9:
            yield (
                f"crowd children must be in [0, groups / 2] = [0, {self.groups / 2:g}], not "
                f"{self.children}: each walks in a group with an adult; give groups of "
                f"{2.0 * self.children:g} or more"
            )
        if self.elderly + 2.0 * self.children > 1.0 + 1e-9:
            yield (
                f"crowd elderly must be in [0, 1 - 2 children] = [0, "
                f"{1.0 - 2.0 * self.children:g}], "
                f"not {self.elderly}: children walk with adults who are not elderly"
            )
        if self.density is not None and self.persons != DEFAULT_PERSONS:
            yield f"crowd: give persons ({self.persons}) or density ({self.density:g}), not both"


class Light(Ranged, frozen=True, kw_only=True):
    """Time of day, clouds and fog; they affect only pictures.

    hour: solar time; the sun is highest at 12.
    cloud_cover: 0 (clear) to 1 (overcast).
    fog_m: meteorological visibility, where 5 % of a contrast is left; None without fog.
    exposure_ev: stops brighter (+) or darker (-) than the camera's automatic exposure.
    hdri: path of an equirectangular Radiance .hdr in place of sky and sun.
    """

    hour: Annotated[float, Within(0, 24)] = 13.0
    day_of_year: Annotated[int, Within(1, 366)] = 172
    latitude_deg: Annotated[float, Within(-90, 90)] = 48.0
    cloud_cover: Annotated[float, Within(0, 1)] = 0.25
    fog_m: Annotated[float | None, Within(10, 50_000)] = None
    exposure_ev: Annotated[float, Within(-4, 4)] = 0.0
    shadows: bool = True
    hdri: Annotated[str, Text(1000)] = ""

    def contradictions(self) -> Iterator[str]:
        if self.hdri and not self.hdri.lower().endswith(".hdr"):
            yield f"light hdri must be a Radiance .hdr file, not {shown(self.hdri)}"


Split = Literal["val", "test"]
"""Splits: val for development and tuning, test for places that no tuning has used."""


class Scenario(Ranged, frozen=True, dict=True, kw_only=True):
    """One episode to run. Raises SpecError for contradictory fields.

    Points are metres in the net's frame: x east, y north. Headings are radians counter-clockwise
    from east.

    start: x, y, heading.
    route: reference route from start to goal.
    structure: what the scenario is an example of: straight, curve, crosswalk, an event kind,
        static, route, or "".
    decoy_of: id of the scenario whose decoy this is, or "". A decoy equals it until its event
        begins, and then needs another response of the robot.
    weather: name in `cosim.spec.weather.WEATHERS`. The default, "clear", is not encoded, so that
        the hashes of older scenarios stay the same; `conditions` is the weather itself.
    go_on_mps: mean speed of the robot from the trigger to 1 m past the person. A decoy without a
        reason to stop requires at least this speed and no stop. An event requires the opposite,
        that the robot gives way. 0 without these rules.

    >>> Scenario(
    ...     id="a", suite="mine", place=City(seed=1, size_m=500.0), seed=0,
    ...     start=(0.0, 0.0, 0.0), goal=(12.0, 0.0), route=((0.0, 0.0), (12.0, 0.0)),
    ... ).time_limit_s
    300.0
    """

    id: Annotated[str, FOLDER]
    suite: Annotated[str, _NAME]
    place: Place
    seed: Annotated[int, SEED]
    start: tuple[float, float, float]
    goal: tuple[float, float]
    route: Annotated[
        tuple[tuple[float, float], ...],
        ItemCount(0, 50_000),
        Points(COORDINATE_M.low, COORDINATE_M.high),
    ]
    crossings: Annotated[tuple[RouteCrossing, ...], ItemCount(0, 1000)] = ()
    barriers: Annotated[tuple[Barrier, ...], ItemCount(0, 1000)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], ItemCount(0, 1000)] = ()
    events: Annotated[tuple[Event, ...], ItemCount(0, 200)] = ()
    crowd: CrowdSpec = CrowdSpec()
    robot: Annotated[str, _NAME] = COURIER.name
    goal_radius_m: Annotated[float, Within(0.1, 20)] = 1.0
    time_limit_s: Annotated[float, Within(0.1, 100_000)] = 300.0
    ends_on_failure: bool = False
    ends_at: Literal["goal", "stop"] = "goal"
    light: Light = Light()
    weather: str | msgspec.UnsetType = msgspec.UNSET
    split: Split = "val"
    structure: Annotated[str, _NAME] = ""
    decoy_of: Annotated[str, _NAME] = ""
    go_on_mps: Annotated[float, Within(0, 10)] = 0.0
    schema: int = _SCHEMA

    @property
    def prefix(self) -> str:
        return "scenario " if FOLDER.refusal("id", self.id) else f"scenario '{self.id}': "

    def __post_init__(self) -> None:
        if self.weather == CLEAR:
            msgspec.structs.force_setattr(self, "weather", msgspec.UNSET)
        super().__post_init__()

    def contradictions(self) -> Iterator[str]:
        if self.schema != _SCHEMA:
            yield (
                f"scenario '{self.id}' has schema {shown(self.schema)}; this version reads "
                f"{_SCHEMA}"
            )
        if self.weather is not msgspec.UNSET:
            yield _weather_fault(self.prefix, self.weather, self.light)
        if len(self.route) < 2:
            yield f"{self.prefix}route needs two points or more"
            return
        for field, (x, y), end in (
            ("start", self.start[:2], self.route[0]),
            ("goal", self.goal, self.route[-1]),
        ):
            if not abs(x - end[0]) + abs(y - end[1]) <= 1e-6:
                yield f"{self.prefix}{field} {(x, y)} is not the route's end {end}"
        yield HEADING_RAD.refusal(f"{self.prefix}start's heading", self.start[2])
        length_m = float(np.hypot(*np.diff(self.route, axis=0).T).sum())
        yield Within(_SHORTEST_M, _LONGEST_M).refusal(
            f"{self.prefix}the length of the route, m,", length_m
        )
        if length_m <= 2.0 * self.goal_radius_m:
            yield (
                f"{self.prefix}goal_radius_m must be less than half of the route's {length_m:g} m, "
                f"not {self.goal_radius_m}"
            )
        places = [
            (crossing.prefix, "leave_s_m", crossing.leave_s_m, _SLACK_M)
            for crossing in self.crossings
        ]
        places += [
            (event.prefix, "route_s_m", event.route_s_m, EVENT_BEYOND_M) for event in self.events
        ]
        for prefix, field, s_m, beyond_m in places:
            if s_m > length_m + beyond_m:
                yield f"{self.prefix}{prefix}{field} is {s_m:g}, but the route ends at {length_m:g}"
        if self.go_on_mps > 0.0 and (not self.events or self.ends_at == "stop"):
            yield f"{self.prefix}go_on_mps needs an event to pass, and ends_at 'goal'"
        names = Counter(name for event in self.events for name in event.names)
        if twice := sorted(name for name, count in names.items() if count > 1):
            yield f"{self.prefix}two events have a pedestrian '{twice[0]}': give one another id"

    @property
    def start_pose(self) -> Pose:
        return Pose(*self.start)

    @property
    def conditions(self) -> Weather:
        """Weather of the scenario."""
        return weather_called(CLEAR if self.weather is msgspec.UNSET else self.weather)

    @property
    def weathered_crowd(self) -> CrowdSpec:
        """Crowd in the scenario's weather, which keeps some children and residents indoors."""
        now = self.conditions
        if now.benches == now.children == 1.0:
            return self.crowd
        return msgspec.structs.replace(
            self.crowd,
            residents=round(now.benches * self.crowd.residents),
            children=now.children * self.crowd.children,
        )

    def in_weather(self, weather: str) -> Scenario:
        """Return the scenario in another weather; unchanged if `weather` is "". Raises SpecError.

        >>> from cosim import load_suite
        >>> load_suite("unit").scenarios[0].in_weather("rain").conditions.rain_mm_h
        4.0
        """
        return msgspec.structs.replace(self, weather=weather) if weather else self

    def driven_by(self, robot: str) -> Scenario:
        """Return the scenario with another robot; unchanged if `robot` is "". Raises UsageError.

        The limits of scenarios that end on a failure scale with the cruise speeds of both robots.
        """
        if not robot or robot == self.robot:
            return self
        faster = robot_called(robot).cruise_mps / robot_called(self.robot).cruise_mps
        limits = {
            "time_limit_s": math.ceil(self.time_limit_s / faster * _TICKS_PER_S - 1e-6)
            / _TICKS_PER_S,
            "go_on_mps": self.go_on_mps * faster,
        }
        scaled = limits if self.ends_on_failure else {}
        return msgspec.structs.replace(self, robot=robot, **scaled)

    @cached_property
    def route_line(self) -> Polyline:
        """Reference route by arc length, made once."""
        return Polyline(self.route)


def _weather_fault(prefix: str, weather: str, light: Light) -> str:
    """Return the error of a weather in a light; "" without one."""
    if fault := weather_fault(weather):
        return f"{prefix}{fault}"
    if light.hdri:
        return (
            f"{prefix}weather '{weather}' contradicts light.hdri, a photographed sky with its own "
            f"weather: leave one of them out"
        )
    return ""


class Suite(Ranged, frozen=True, kw_only=True):
    """Named, versioned list of scenarios. Raises SpecError for duplicate ids.

    >>> len(Suite(name="mine", version="1", scenarios=()).content_hash)
    16
    """

    name: Annotated[str, PathName("a suite, and the folder of a run")]
    version: Annotated[str, _NAME]
    scenarios: tuple[Scenario, ...]
    description: Annotated[str, Text(10_000)] = ""

    def contradictions(self) -> Iterator[str]:
        times = Counter(scenario.id for scenario in self.scenarios)
        if twice := sorted(name for name, count in times.items() if count > 1):
            more = f" and {len(twice) - 5} more" if len(twice) > 5 else ""
            yield f"suite '{self.name}' lists scenarios twice: {', '.join(twice[:5])}{more}"
        decoys = {one.id for one in self.scenarios if one.decoy_of}
        for one in self.scenarios:
            if one.decoy_of in decoys:
                yield f"{one.prefix}decoy_of names another decoy: {shown(one.decoy_of)}"

    @property
    def content_hash(self) -> str:
        """SHA-256 of the suite's canonical JSON, 16 hex digits."""
        return content_hash(self)

    @property
    def ends_on_failure(self) -> bool:
        """Whether all scenarios end on a failure, so that rates of failures mean nothing."""
        return all(one.ends_on_failure for one in self.scenarios)


def split_called(name: str | None) -> Split | None:
    """Return the split with a name. Raises UsageError with the valid names."""
    if name not in (None, *get_args(Split)):
        raise unknown("split", str(name), get_args(Split))
    return cast(Split | None, name)


def content_hash(spec: msgspec.Struct) -> str:
    """Return the SHA-256 of a spec's canonical JSON, 16 hex digits."""
    return hashlib.sha256(_canonical(spec)).hexdigest()[:16]


def _canonical(spec: msgspec.Struct) -> bytes:
    return msgspec.json.encode(spec, order="deterministic")


def event_faults(scenario: Scenario, kinds: EventKinds, place: str = "$") -> Iterator[str]:
    """Yield the errors of a scenario's events with respect to a table of kinds.

    place: path of the scenario in its file.
    """
    for number, event in enumerate(scenario.events):
        at = f"{place}.events[{number}]"
        if event.kind not in kinds:
            yield (
                f"Invalid enum value {shown(event.kind)} - at `{at}.kind`. Valid choices: "
                f"{', '.join(kinds)}"
            )
            continue
        fewest, most = kinds[event.kind].people
        if not fewest <= event.people <= most:
            allowed = f"{fewest}" if fewest == most else f"{fewest} to {most}"
            yield (
                f"{event.prefix}people of '{event.kind}' must be {allowed}, not "
                f"{shown(event.people)} - at `{at}`"
            )
        if event.decoy and kinds[event.kind].decoy is None:
            yield f"{event.prefix}'{event.kind}' has no behaviour of decoys - at `{at}.decoy`"
        if event.free_side and not kinds[event.kind].has_free_side:
            yield f"{event.prefix}free_side of '{event.kind}' must be 0 - at `{at}.free_side`"
        if (kinds[event.kind].layout is None) != (event.half_length_m > 0.0):
            crossings = " and ".join(
                f"'{kind.name}'" for kind in kinds.values() if kind.layout is None
            )
            yield (
                f"{event.prefix}half_length_m is the crosswalk's: of {crossings}, and of no "
                f"other - at `{at}`"
            )
    stops = [kind.name for kind in kinds.values() if kind.ends_at == "stop"]
    if scenario.ends_at == "stop" and not any(event.kind in stops for event in scenario.events):
        needed = " or ".join(f"'{name}'" for name in stops)
        yield (
            f"{scenario.prefix}ends_at 'stop' needs an event {needed}: a person to stop for - at "
            f"`{place}`"
        )


def decoy_faults(suite: Suite) -> Iterator[str]:
    """Yield the errors of a whole suite whose decoys lack their scenario; a part may lack it."""
    events = {one.id for one in suite.scenarios if not one.decoy_of}
    for i, one in enumerate(suite.scenarios):
        if one.decoy_of and one.decoy_of not in events:
            yield (
                f"{one.prefix}decoy_of names no scenario of the suite: {shown(one.decoy_of)} - at "
                f"`$.scenarios[{i}].decoy_of`"
            )


def read_suite(path: Path, kinds: EventKinds | None = None) -> Suite:
    """Load the suite of a JSON file. Raises SpecError with file, field and valid choices.

    kinds: table of event kinds to check against; None for a file that was checked before.
    """
    suite = read_spec_file(path, Suite)
    if not suite.scenarios:
        raise SpecError(
            f"{path}: suite '{suite.name}' has no scenarios: `scenarios` needs one or more"
        )
    if kinds is not None:
        faults_by_scenario = (
            event_faults(one, kinds, f"$.scenarios[{i}]") for i, one in enumerate(suite.scenarios)
        )
        if faults := [*chain.from_iterable(faults_by_scenario), *decoy_faults(suite)]:
            raise SpecError(f"{path}: {join_faults(faults)}")
    return suite


def write_suite(suite: Suite, path: Path) -> None:
    """Write a suite as readable JSON, one scenario a line."""
    head = msgspec.json.encode(
        {"name": suite.name, "version": suite.version, "description": suite.description}
    )
    rows = b",\n".join(_canonical(s) for s in suite.scenarios)
    path.write_bytes(head[:-1] + b',"scenarios":[\n' + rows + b"\n]}\n")
