"""Scenario and Suite: frozen specs of what is measured, and their files.

A spec is complete: the same spec gives the same episode, bit for bit, in any process.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import msgspec
from msgspec import inspect as info

from cosim.errors import SpecError
from cosim.events import Event
from cosim.geometry import Polyline, Pose

SCHEMA = 1
"""Version of the scenario files; a reader refuses others."""
_FOLDER_NAME = re.compile(r"[^./\\\x00-\x1f][^/\\\x00-\x1f]{0,99}")


class _Uneven(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A place whose ground may be uneven. roughness: from 0 (flat) to 1; a spec of flat ground does not mention it,
    so that it keeps the hash it had before there was uneven ground."""

    roughness: float | msgspec.UnsetType = msgspec.UNSET

    def __post_init__(self) -> None:
        if not 0.0 <= self.unevenness <= 1.0:
            raise SpecError(f"roughness is {self.unevenness:g}, but it lies between 0 (flat) and 1")
        if self.roughness == 0.0:
            msgspec.structs.force_setattr(self, "roughness", msgspec.UNSET)

    @property
    def unevenness(self) -> float:
        """The roughness of the ground, 0 where the spec does not mention it."""
        return 0.0 if isinstance(self.roughness, msgspec.UnsetType) else self.roughness


class City(_Uneven, frozen=True, kw_only=True, tag="city", tag_field="kind"):
    """A procedural city. net_hash: content hash of the street net the scenario was made on."""

    seed: int
    size_m: float = 2000.0
    style: str = "mixed"
    net_hash: str = ""

    @property
    def name(self) -> str:
        return f"city-{self.style}-{self.size_m:g}m-{self.seed}"


class CityMap(_Uneven, frozen=True, kw_only=True, tag="map", tag_field="kind"):
    """An imported map, by its name in the store of maps. seed: of what the map does not say (buildings, props)."""

    map: str
    seed: int = 0
    net_hash: str = ""

    @property
    def name(self) -> str:
        return f"map-{self.map}"


Place = City | CityMap


class Barrier(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A fence across a way. heading_rad: along the way it closes; length_m: across it.

    strip, end: the port of the walking graph that it closes.
    """

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    strip: str
    end: Literal[0, 1]
    thickness_m: float = 0.12
    height_m: float = 1.0


class RouteCrossing(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A crossing of the reference route, from arc length enter_s_m to leave_s_m."""

    id: str
    enter_s_m: float
    leave_s_m: float
    signalised: bool


DEFAULT_PERSONS = 50
MOST_PER_1000_M2 = 150.0
"""Denser crowds have no room to enter 1.5 m apart."""
MOST_RESIDENTS = 60


class CrowdSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The street life around the robot: persons and vehicles kept within radius_m of it.

    density: persons per 1000 m2 of walkable ground there, in place of a number of persons.
    residents: people besides who know the street, sit on its benches, look into its shop windows, wait at its stops
    (`scenarios.residents`); so many are kept within 60 m of the robot.
    Shares of the persons: groups, of those who walk in groups of two and three; elderly and children, of those who walk
    slower than others. A child walks in a group with an adult, at the child's pace.
    """

    persons: int = DEFAULT_PERSONS
    radius_m: float = 80.0
    vehicles: int = 20
    density: float | msgspec.UnsetType = msgspec.UNSET
    residents: int = 0
    groups: float = 0.0
    elderly: float = 0.0
    children: float = 0.0

    def __post_init__(self) -> None:
        self._check_shares()
        if not 0 <= self.residents <= MOST_RESIDENTS:
            raise SpecError(f"crowd residents must be in [0, {MOST_RESIDENTS}], not {self.residents}")
        if self.persons < 0 or self.vehicles < 0:
            raise SpecError(f"persons and vehicles cannot be negative: {self.persons}, {self.vehicles}")
        if not 20.0 <= self.radius_m <= 500.0:
            raise SpecError(f"crowd radius_m must be in [20, 500], not {self.radius_m}")
        if isinstance(self.density, msgspec.UnsetType):
            return
        if not 0.0 <= self.density <= MOST_PER_1000_M2:
            raise SpecError(f"crowd density must be in [0, {MOST_PER_1000_M2:g}] per 1000 m2, not {self.density}")
        if self.persons != DEFAULT_PERSONS:
            raise SpecError(f"crowd: give persons ({self.persons}) or density ({self.density:g}), not both")

    def _check_shares(self) -> None:
        for field in ("groups", "elderly", "children"):
            if not 0.0 <= getattr(self, field) <= 1.0:
                raise SpecError(f"crowd {field} must be a share in [0, 1], not {getattr(self, field)}")
        if 2.0 * self.children > self.groups + 1e-9:
            raise SpecError(
                f"crowd children must be in [0, groups / 2] = [0, {self.groups / 2:g}], not {self.children}: "
                f"each walks in a group with an adult; give groups of {2.0 * self.children:g} or more"
            )
        if self.elderly + 2.0 * self.children > 1.0 + 1e-9:
            raise SpecError(
                f"crowd elderly must be in [0, 1 - 2 children] = [0, {1.0 - 2.0 * self.children:g}], "
                f"not {self.elderly}: children walk with adults who are not elderly"
            )


class Light(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """Time of day and weather of a scenario: what they do to pictures, and to nothing else.

    hour: solar time, the sun highest at 12. cloud_cover: 0 (clear) to 1 (overcast). fog_m: the distance at which fog
    leaves 5 % of a contrast (the meteorologists' visibility), None without fog. exposure_ev: stops brighter (+) or
    darker (-) than the camera would choose. hdri: path of an equirectangular Radiance .hdr that replaces sky and sun.
    """

    hour: float = 13.0
    day_of_year: int = 172
    latitude_deg: float = 48.0
    cloud_cover: float = 0.25
    fog_m: float | None = None
    exposure_ev: float = 0.0
    shadows: bool = True
    hdri: str = ""

    def __post_init__(self) -> None:
        ranges = {
            "hour": (0.0, 24.0), "day_of_year": (1, 366), "latitude_deg": (-90.0, 90.0), "cloud_cover": (0.0, 1.0),
            "fog_m": (10.0, 50_000.0), "exposure_ev": (-4.0, 4.0),
        }  # fmt: skip
        for field, (low, high) in ranges.items():
            value = getattr(self, field)
            if value is not None and not low <= value <= high:
                raise SpecError(f"light {field} must be in [{low:g}, {high:g}], not {value}")
        if self.hdri and not self.hdri.lower().endswith(".hdr"):
            raise SpecError(f"light hdri must be a Radiance .hdr file, not '{self.hdri}'")


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One episode to run. start: x, y, heading. route: the reference route from start to goal, in metres."""

    id: str
    suite: str
    place: Place
    seed: int
    start: tuple[float, float, float]
    goal: tuple[float, float]
    route: tuple[tuple[float, float], ...]
    crossings: tuple[RouteCrossing, ...] = ()
    barriers: tuple[Barrier, ...] = ()
    events: tuple[Event, ...] = ()
    crowd: CrowdSpec = CrowdSpec()
    robot: str = "courier"
    goal_radius_m: float = 1.0
    time_limit_s: float = 300.0
    ends_on_failure: bool = False
    ends_at: Literal["goal", "stop"] = "goal"
    light: Light = Light()
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if not _FOLDER_NAME.fullmatch(self.id):
            raise SpecError(f"scenario id '{self.id}' cannot name a folder: no '/', no '.' in front, 1 to 100 letters")
        if self.schema != SCHEMA:
            raise SpecError(f"scenario '{self.id}' has schema {self.schema}; this version reads {SCHEMA}")
        if len(self.route) < 2:
            raise SpecError(f"scenario '{self.id}': route needs two points or more")
        for field, (x, y), end in (("start", self.start[:2], self.route[0]), ("goal", self.goal, self.route[-1])):
            if abs(x - end[0]) + abs(y - end[1]) > 1e-6:
                raise SpecError(f"scenario '{self.id}': {field} {(x, y)} is not the route's end {end}")
        if not self.goal_radius_m > 0 or not self.time_limit_s > 0:
            raise SpecError(f"scenario '{self.id}': goal_radius_m and time_limit_s must be positive")
        names = [name for event in self.events for name in event.names]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise SpecError(f"scenario '{self.id}': two events have a pedestrian '{twice[0]}': give one another id")

    @property
    def start_pose(self) -> Pose:
        return Pose(*self.start)

    @property
    def route_line(self) -> Polyline:
        return Polyline(self.route)


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A named, versioned list of scenarios."""

    name: str
    version: str
    scenarios: tuple[Scenario, ...]
    description: str = ""

    def __post_init__(self) -> None:
        ids = [scenario.id for scenario in self.scenarios]
        twice = sorted({i for i in ids if ids.count(i) > 1})
        if twice:
            raise SpecError(f"suite '{self.name}' lists scenarios twice: {', '.join(twice)}")

    @property
    def content_hash(self) -> str:
        """SHA-256 of the suite's canonical JSON, 16 hex digits."""
        return content_hash(self)


def content_hash(spec: msgspec.Struct) -> str:
    """SHA-256 of a spec's canonical JSON, 16 hex digits."""
    return hashlib.sha256(_canonical(spec)).hexdigest()[:16]


ADDED: Mapping[str, object] = MappingProxyType(
    {
        "light": {}, "ends_at": "goal", "people": 1, "half_length_m": 0.0, "residents": 0,
        "groups": 0.0, "elderly": 0.0, "children": 0.0,
    }
)  # fmt: skip
"""Fields that came later, with the values that mean what was meant before there were such fields."""


def _canonical(spec: msgspec.Struct) -> bytes:
    """JSON of a spec. What was ADDED is left out of scenarios, crowds and events where it says nothing new, so that a
    spec has the bytes and the hash it had before."""
    tree = msgspec.to_builtins(spec, order="deterministic")
    for scenario in tree.get("scenarios", [tree]):
        for part in (scenario, scenario.get("crowd", {}), *scenario.get("events", ())):
            for field in [name for name, before in ADDED.items() if part.get(name) == before]:
                del part[field]
    return msgspec.json.encode(tree)


def read_suite(path: Path) -> Suite:
    """The suite in a JSON file. Raises SpecError naming the file and the field, and what may stand there."""
    try:
        suite = msgspec.json.decode(path.read_bytes(), type=Suite)
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, SpecError) as error:
        raise SpecError(f"{path}: {error}{_choices(str(error))}") from error
    if not suite.scenarios:
        raise SpecError(f"{path}: suite '{suite.name}' has no scenarios: `scenarios` needs one or more")
    return suite


def _choices(refusal: str) -> str:
    """What msgspec does not say when it refuses a field or a name: the valid ones."""
    found = re.fullmatch(r"(Object contains unknown field|Invalid enum value) .*?( - at `(.*)`)?", refusal)
    if found is None:
        return ""
    here: Any = info.type_info(Suite)
    for step in re.findall(r"\.(\w+)|(\[)", found[3] or ""):
        here = _below(here, *step)
    kinds = getattr(here, "types", (here,))
    valid = getattr(here, "values", ()) or [f.encode_name for kind in kinds for f in getattr(kind, "fields", ())]
    return f". Valid choices: {', '.join(dict.fromkeys(map(str, valid)))}" if valid else ""


def _below(here: Any, field: str, item: str) -> Any:
    """The msgspec type of a field of a struct, or of the items of a tuple."""
    if item:
        return getattr(here, "item_type", None)
    return next((f.type for f in getattr(here, "fields", ()) if f.encode_name == field), None)


def write_suite(suite: Suite, path: Path) -> None:
    """Write a suite as readable JSON: one scenario a line."""
    head = msgspec.json.encode({"name": suite.name, "version": suite.version, "description": suite.description})
    rows = b",\n".join(_canonical(s) for s in suite.scenarios)
    path.write_bytes(head[:-1] + b',"scenarios":[\n' + rows + b"\n]}\n")
