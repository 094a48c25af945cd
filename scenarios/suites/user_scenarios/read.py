"""Reader of user scenario files, in TOML. A list in place of a value is a sweep.

    crowd.density = [0, 10]
    seeds = 3

are six scenarios: all combinations of the values, each with the seeds 0, 1 and 2. A file with
faults is refused with all of them.
"""

from __future__ import annotations

import itertools
import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args, get_origin

import msgspec

from cosim.core.errors import SpecError, unknown
from cosim.spec.robot import ROBOTS
from cosim.spec.spec_file import bare_type, faults_in, join_faults
from cosim.spec.validation import shown
from scenarios.events import EVENT_KINDS
from scenarios.suites.user_scenarios.format import OwnScenario
from sumo_nets.city.city import STYLES
from sumo_nets.maps.map_store import known_maps

_MAX_BYTES: Final = 1_000_000
_MAX_SCENARIOS: Final = 5000
_ONE_VALUE: Final = ("name", "description", "seeds")
"""Fields that apply to the whole file."""
_SUITES: Final = Path(__file__).parents[1]
_LONGEST_NAME: Final = 100
_AT: Final = re.compile(r" - at `\$\.?([^`]*)`")
_TYPES: Final = {
    "int": "a whole number",
    "float": "a number",
    "str": "text in quotes",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
}
_SIZE: Final = re.compile(r"of length (\d+)")
_STEP: Final = re.compile(r"([^.\[\]]+)|\[(\d+)\]")


class Axis(NamedTuple):
    """Field of a sweep. field: such as "crowd.density" or "events[0].at_m"."""

    field: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Variant:
    """Scenario of a file. at: value of each field of the sweep."""

    id: str
    own: OwnScenario
    at: dict[str, Any]


@dataclass(frozen=True)
class OwnFile:
    """Parsed file. variants: all scenarios of its sweep, or one."""

    path: Path
    name: str
    description: str
    axes: tuple[Axis, ...]
    variants: tuple[Variant, ...]


def read_own(path: Path) -> OwnFile:
    """Read the scenarios of a TOML file.

    Raises SpecError with the file and every fault: its field, the value and the valid values.
    """
    tree = _toml(path)
    axes = tuple(_axes(tree, OwnScenario, ""))
    faults = [
        f"{axis.field} is an empty list: give values to sweep over"
        for axis in axes
        if not axis.values
    ]
    if not faults:
        faults = _faults_of_each(tree, axes)
    seeds = tree.get("seeds", 1)
    count = math.prod(len(axis.values) for axis in axes) * (seeds if isinstance(seeds, int) else 1)
    if count > _MAX_SCENARIOS:
        faults.append(
            f"makes {count} scenarios, and at most {_MAX_SCENARIOS} can be had: give fewer "
            f"values or seeds"
        )
    if faults:
        raise SpecError(f"{path}: {join_faults(faults, len(faults))}")
    try:
        variants = tuple(_variants(tree, axes, path.parent))
    except msgspec.ValidationError as error:
        raise SpecError(f"{path}: {_in_words(str(error), tree)}") from error
    first = variants[0].own
    return OwnFile(path, first.name, first.description, axes, variants)


def label(value: Any) -> str:
    """Format a value of a sweep for tables."""
    if isinstance(value, list):
        return f"({', '.join(map(label, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _toml(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not path.is_file():
            raise SpecError(f"{path}: is no file: give the path of a .toml file")
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except OSError as error:
        remedy = (
            f": `cosim scenario new {path}` writes one"
            if isinstance(error, FileNotFoundError)
            else ""
        )
        raise SpecError(f"{path}: cannot be read: {error.strerror}{remedy}") from error
    if len(data) > _MAX_BYTES:
        raise SpecError(f"{path}: holds more than {_MAX_BYTES} bytes: no scenario is so long")
    try:
        return tomllib.loads(data.removeprefix(b"\xef\xbb\xbf").decode())
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise SpecError(f"{path}: is no UTF-8 text, line {line}: save it as UTF-8") from error
    except RecursionError as error:
        raise SpecError(
            f"{path}: is nested too deep: brackets within brackets within brackets"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{path}: is no TOML: {error}") from error


def _axes(tree: Any, kind: Any, field: str) -> Iterator[Axis]:
    """Yield the axes of the sweep: fields whose values are lists of their type."""
    kind = bare_type(kind, tree)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        types = {one.name: one.type for one in msgspec.structs.fields(kind)}
        for name in tree if isinstance(tree, dict) else ():
            if name in types and (field or name not in _ONE_VALUE):
                yield from _axes(tree[name], types[name], f"{field}.{name}".removeprefix("."))
    elif _holds_tables(kind):
        for number, item in enumerate(tree if isinstance(tree, list) else ()):
            yield from _axes(item, get_args(kind)[0], f"{field}[{number}]")
    elif isinstance(tree, list) and _depth(tree) > _depth_of_type(kind):
        yield Axis(field, tuple(tree))


def _holds_tables(kind: Any) -> bool:
    return (
        get_origin(kind) is tuple
        and isinstance(get_args(kind)[0], type)
        and issubclass(get_args(kind)[0], msgspec.Struct)
    )


def _depth(value: Any) -> int:
    return 1 + max(map(_depth, value), default=0) if isinstance(value, list) else 0


def _depth_of_type(kind: Any) -> int:
    kind = bare_type(kind, 0)
    return 1 + _depth_of_type(get_args(kind)[0]) if get_origin(kind) is tuple else 0


def _faults_of_each(tree: dict[str, Any], axes: Sequence[Axis]) -> list[str]:
    """Return each fault of the file once: with the first value of each axis, then each other
    value.
    """
    first = tree
    for axis in axes:
        first = _with(first, axis.field, axis.values[0])
    trees = [
        first,
        *(_with(first, axis.field, value) for axis in axes for value in axis.values[1:]),
    ]
    faults = (fault for one in trees for fault in (*_misread(one), *_unknown_names(one)))
    return list(dict.fromkeys(faults))


def _misread(tree: dict[str, Any]) -> Iterator[str]:
    return (_in_words(fault, tree) for fault in faults_in(tree, OwnScenario, "$"))


def _in_words(fault: str, tree: dict[str, Any]) -> str:
    """Describe a fault with its field and value, in the terms of the file."""
    at = _AT.search(fault)
    if at is None:
        return fault
    message = fault[: at.start()]
    more = fault[at.end() :]
    message = message.replace("Object contains unknown field", "unknown field")
    message = message.replace("Object missing required field", "there is no")
    found = ""
    if message.startswith("Expected `"):
        wanted = message.split("`")[1].removesuffix(" | null")
        size = _SIZE.search(message)
        message = f"must be {_TYPES.get(wanted, wanted)}{f' of {size[1]} values' if size else ''}"
        found = f", not {shown(_found(tree, at[1]))}"
    where = "" if message.startswith(at[1]) else f"{at[1]}: "
    return f"{where}{message}{found}{more}"


def _found(tree: Any, field: str) -> Any:
    for name, number in _STEP.findall(field):
        try:
            tree = tree[int(number)] if number else tree[name]
        except (LookupError, TypeError):
            return None
    return tree


def _unknown_names(tree: dict[str, Any]) -> Iterator[str]:
    """Yield unknown names of robots, events, maps and styles."""
    events = tree.get("events")
    wanted: list[tuple[str, Any, Any]] = [
        ("robot", "robot", ROBOTS),
        ("place.style", "city style", STYLES),
        ("place.map", "map", known_maps()),
        *(
            (f"events[{n}].kind", "event", EVENT_KINDS)
            for n in range(len(events) if isinstance(events, list) else 0)
        ),
    ]
    for field, what, valid in wanted:
        value = _found(tree, field)
        if isinstance(value, str) and value and value not in valid:
            yield f"{field}: {unknown(what, value, valid)}"
    name = tree.get("name")
    if isinstance(name, str) and Path(name).name == name and (_SUITES / f"{name}.json").exists():
        yield f"name {shown(name)} is that of a suite that ships: choose another"


def _with(tree: Any, field: str, value: Any) -> Any:
    """Return a tree with another value at a field."""
    return _with_at(
        tree, [int(number) if number else name for name, number in _STEP.findall(field)], value
    )


def _with_at(tree: Any, steps: Sequence[str | int], value: Any) -> Any:
    changed: Any = list(tree) if isinstance(tree, list) else dict(tree)
    changed[steps[0]] = _with_at(tree[steps[0]], steps[1:], value) if len(steps) > 1 else value
    return changed


def _variants(tree: dict[str, Any], axes: Sequence[Axis], folder: Path) -> Iterator[Variant]:
    seeds = tree.get("seeds", 1)
    for picked in itertools.product(*(range(len(axis.values)) for axis in axes)):
        at = {axis.field: axis.values[k] for axis, k in zip(axes, picked, strict=True)}
        one = tree
        for field, value in at.items():
            one = _with(one, field, value)
        own = msgspec.convert(one, OwnScenario)
        own = _beside(own, folder)
        for repetition in range(seeds):
            seed = (own.seed + repetition) % 2**32
            repeated = msgspec.structs.replace(own, seed=seed, seeds=1)
            yield Variant(_id_of(own.name, axes, picked, seed if seeds > 1 else None), repeated, at)


def _beside(own: OwnScenario, folder: Path) -> OwnScenario:
    """Return the tree with paths resolved from the folder of its file."""
    replace = msgspec.structs.replace
    place = own.place
    light = own.light
    if place.file:
        own = replace(own, place=replace(place, file=str((folder / place.file).resolve())))
    return (
        replace(own, light=replace(light, hdri=str((folder / light.hdri).resolve())))
        if light.hdri
        else own
    )


def _id_of(name: str, axes: Sequence[Axis], picked: Sequence[int], seed: int | None) -> str:
    """Return the name of a scenario: with its values if these are short and distinct, else
    numbers.
    """
    parts = [name]
    for axis, k in zip(axes, picked, strict=True):
        words = [re.sub(r"[^A-Za-z0-9._-]+", "_", label(value)).strip("_") for value in axis.values]
        short = len(set(words)) == len(words) and max(map(len, words)) <= 16 and all(words)
        field = re.sub(r"[^A-Za-z0-9_]+", "", axis.field.split(".")[-1])
        parts.append(f"{field}{words[k]}" if short else f"{field}-{k}")
    parts += [] if seed is None else [f"s{seed}"]
    whole = "-".join(parts)
    if len(whole) > _LONGEST_NAME:
        numbers = [str(k) for k in picked] + parts[len(picked) + 1 :]
        whole = "-".join([name[:60], *numbers])
    return whole
