"""The table of all observation attributes in docs/observations.md, against observations of real
episodes."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple, get_args

import msgspec
import numpy as np
import pytest
from shapely.geometry.base import BaseGeometry

from bridge.policy_server import ActRequest, EpisodeDecoder, pack_array, unpack_array
from cosim.core.geometry import Polyline
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import calibration_of
from cosim.spec.camera import CameraPicture, CameraSpec
from cosim.spec.goal import GOALS, GoalProtocol, ImageGoal, Instruction, PointGoal, RoutePatch
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import Odometry
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER
from cosim.spec.scenario import CrowdSpec
from cosim.spec.sensors import ScanSpec
from scenarios.episodes.episode import Episode
from scenarios.ipc.observation_codec import (
    ObservationDecoder,
    encode_constants,
    encode_extra,
    encode_observation,
)
from scenarios.tools.verify.doctor import small_scenario
from tests.support.documents import text_of

SPEC = CameraSpec(32, 24, depth=True, labels=True)
ALL = Manifest(
    "all",
    camera=SPEC,
    odometry="wheel",
    scan=ScanSpec(rays=24, rings=2, elevation_deg=(-5.0, 5.0)),
    imu="noisy",
    people="seen",
    privileged=True,
    cameras={"left": CameraSpec(16, 12, mount="left", depth=True, labels=True)},
)
CAMERA = calibration_of(SPEC, COURIER)
WHOLE = ("Skid", "Mount", "ScanSpec", "Polyline", "Polygon", "MultiPolygon", "Pose", "Signal")
"""Types whose parts the table names in words, if at all."""


class Row(NamedTuple):
    """An attribute in the table; its value has one of `types`."""

    path: str
    asked: str
    types: tuple[str, ...]
    words: str


def table() -> list[Row]:
    """Return the rows of the page's table, one for each attribute."""
    lines = (
        text_of("docs/observations.md")
        .partition("| of `observation` |")[2]
        .partition("\n\n")[0]
        .splitlines()[2:]
    )
    found = []
    for line in lines:
        named, requested_by, types, words = (cell.strip() for cell in line.strip("|").split(" | "))
        stated = tuple(types.split(" or ")) if " of " not in types else (types,)
        found += [
            Row(path, requested_by, stated, words) for path in re.findall(r"`([^`]+)`", named)
        ]
    return found


TABLE = table()


def fits(value: Any, stated: str) -> bool:
    """Return whether a value has the type that a cell of the table states."""
    of = re.fullmatch(r"`(\w+)` of `(\w+)` to `(\w+)`", stated)
    if of:
        holds, key, item = of.groups()
        pairs = [*value.items()] if isinstance(value, Mapping) else [(None, None)]
        return fits(value, f"`{holds}`") and all(
            fits(k, f"`{key}`") and fits(v, f"`{item}`") for k, v in pairs
        )
    array = re.fullmatch(r"`\((.*)\) (\w+)`", stated)
    if array is None:
        return stated == f"`{type(value).__name__}`".replace("NoneType", "None")
    sides = [side.strip() for side in array[1].split(",") if side.strip()]
    return (
        isinstance(value, np.ndarray)
        and value.dtype == array[2]
        and value.ndim == len(sides)
        and all(
            size == int(side)
            for size, side in zip(value.shape, sides, strict=True)
            if side.isdigit()
        )
    )


def public_attributes(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Return every public attribute of an observation by its path: fields and properties, cameras
    once."""
    if isinstance(value, Mapping) and "signals" not in path and "mounts" not in path:
        for name, item in value.items():
            yield from public_attributes(item, f'{path}["{name}"]')
        return
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
    elif isinstance(value, msgspec.Struct):
        names = list(value.__struct_fields__)
    elif isinstance(value, SimpleNamespace):
        names = list(vars(value))
    else:
        return
    names += [
        name
        for name, part in vars(type(value)).items()
        if isinstance(part, property) and name[0] != "_"
    ]
    for name in names:
        below = f"{path}.{name}".removeprefix(".")
        part = getattr(value, name)
        yield below, part
        if type(part).__name__ not in WHOLE and name != "spec":
            yield from public_attributes(part, "camera" if name == "camera" else below)


def mismatches(seen: Any, goal: str = "") -> list[str]:
    """Return attributes of an observation that the table lacks or gives another type, for a goal
    protocol."""
    found = []
    for path, value in public_attributes(seen):
        rows = [
            row
            for row in TABLE
            if row.path == path and (path != "goal" or f'goal="{goal}"' in row.asked)
        ]
        types = [stated for row in rows for stated in row.types]
        if not any(fits(value, stated) for stated in types):
            found.append(f"{path} is {value!r}, not {' or '.join(types)}")
    return found


def paths(seen: Any) -> set[str]:
    return {path for path, _ in public_attributes(seen)}


@pytest.fixture(scope="module")
def seen() -> dict[str, Observation]:
    """Observations by each goal protocol of a policy that requests everything, one of them among
    people."""
    found = {}
    for protocol in get_args(GoalProtocol):
        scenario = small_scenario()
        if protocol != "none":
            scenario = msgspec.structs.replace(
                scenario, crowd=CrowdSpec(persons=0, vehicles=0), events=()
            )
        with Episode(
            scenario, ALL, EpisodeOptions(seed=1, goal=protocol, camera="bullet")
        ) as episode:
            episode.reset()
            found[protocol] = episode.advance(Command(1.0, 0.0))
    return found


@pytest.mark.engine
def test_the_table_has_every_attribute_of_an_observation(seen: dict[str, Observation]) -> None:
    """By every goal protocol each attribute is in the table with its type, and no other is."""
    for protocol, one in seen.items():
        assert mismatches(one, protocol) == []
    assert {row.path for row in TABLE} == set().union(*map(paths, seen.values()))
    assert {row.asked for row in TABLE if row.path == "goal"} == {
        f'`goal="{protocol}"`' for protocol in seen
    }
    known = seen["none"].privileged
    assert known is not None and len(known.people) > 3 and len(known.signals) > 0


def test_the_table_of_goal_protocols_is_that_of_the_source() -> None:
    """The page has name, type and summary of each row of `GOALS`, in their order."""
    lines = (
        text_of("docs/observations.md")
        .partition("| `goal=` |")[2]
        .partition("\n\n")[0]
        .splitlines()[2:]
    )
    types = {
        kind.name: "None" if kind.type is None else f"cosim.{kind.type.__name__}"
        for kind in GOALS.values()
    }
    assert lines == [
        f"| `{kind.name}` | `{types[kind.name]}` | {kind.summary} |" for kind in GOALS.values()
    ]
    assert get_args(GoalProtocol) == tuple(GOALS)


def test_attributes_that_are_not_requested_are_none() -> None:
    """A default observation is None where the table says so."""
    fields = {field.name: field.default for field in dataclasses.fields(Observation)}
    absent = {row.path for row in TABLE if "`None`" in row.words and "." not in row.path} | {
        "depth",
        "labels",
    }
    assert absent == {
        "rgb",
        "camera",
        "depth",
        "labels",
        "odometry",
        "scan",
        "imu",
        "people",
        "privileged",
    }
    assert all(fields[name] is None for name in absent - {"rgb"}) and fields["goal"] is None


@pytest.mark.engine
def test_the_table_holds_for_isolated_and_served_policies(seen: dict[str, Observation]) -> None:
    """Types are the same with cosim; without it names and arrays are, except for those that the
    page lists."""
    listed = (
        text_of("docs/observations.md")
        .partition("It lacks these attributes: ")[2]
        .partition("\n\n")[0]
    )
    lacking = set(re.findall(r"`([\w.]+)`", listed))
    assert len(lacking) == 6
    for protocol, one in seen.items():
        afar, plain = decoded_elsewhere(one)
        given = dataclasses.replace(one, privileged=None)
        assert paths(afar) == paths(given) and paths(plain) == paths(given) - lacking
        own = [
            line
            for line in mismatches(plain, protocol)
            if "namespace(" not in line and "_Plain" not in line
        ]
        assert {*mismatches(afar, protocol), *own} == {"privileged is None, not `Privileged`"}
        for name in ("odometry", "scan", "imu", "people", "goal"):
            if name != "goal" or protocol not in ("none", "instruction"):
                assert np.array_equal(getattr(plain, name), getattr(one, name))


def decoded_elsewhere(seen: Observation) -> tuple[Observation, SimpleNamespace]:
    """Return what a policy gets in another process with cosim, and in one without."""
    fields, arrays = encode_observation(dataclasses.replace(seen, privileged=None))
    laid = {name: pack_array(array) for name, array in arrays.items()}
    about = encode_constants(seen)
    request = ActRequest("r", seen.episode, "a", 0, **fields, arrays=laid, about=about)
    received = msgspec.msgpack.decode(msgspec.msgpack.encode(request), type=ActRequest)
    copies = {name: unpack_array(array) for name, array in received.arrays.items()}
    afar, plain = (
        kind(seen.episode, received.about).decoded(received, copies)
        for kind in (ObservationDecoder, EpisodeDecoder)
    )
    return afar, plain


@pytest.mark.engine
def test_an_observation_that_is_sent_arrives_equal_to_the_bit(seen: dict[str, Observation]) -> None:
    """By every goal protocol each array and number arrives, privileged knowledge included."""
    for one in seen.values():
        fields, arrays = encode_observation(one)
        request = ActRequest("r", one.episode, "a", 0, **fields)
        received = ObservationDecoder(one.episode, encode_constants(one)).decoded(request, arrays)
        assert bytes_of(one) == bytes_of(received)


def bytes_of(seen: Observation) -> bytes:
    """Return everything in an observation as bytes."""

    def extra(value: object) -> object:
        if isinstance(value, Polyline):
            return value.points
        return value.wkb if isinstance(value, BaseGeometry) else encode_extra(value)

    return msgspec.msgpack.encode(seen, enc_hook=extra)


def test_goals_and_odometry_are_arrays_for_numpy() -> None:
    """Points, poses and pictures convert to arrays, other goals name the attribute to read;
    equality and hashes follow the fields."""
    point = PointGoal(3.0, -4.0)
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert np.asarray(point).tolist() == [3.0, -4.0] and np.asarray(point).dtype == float
    assert np.asarray(point, np.float32).dtype == np.float32 and np.linalg.norm(point) == 5.0  # type: ignore[arg-type]
    assert np.stack([point, point]).shape == (2, 2)  # type: ignore[call-overload]
    assert np.asarray(Odometry(1.0, 2.0, 0.5)).tolist() == [1.0, 2.0, 0.5]
    assert np.asarray(Odometry(1.0, 2.0, None)).tolist() == [1.0, 2.0]
    for expected in (
        ImageGoal(pixels),
        RoutePatch(pixels),
        CameraPicture(pixels, None, None, CAMERA),
    ):
        assert (
            np.asarray(expected) is pixels and np.asarray(expected, np.float32).dtype == np.float32
        )
    for expected, words in (
        (Instruction("Stop."), "read observation.goal.text"),
        (CAMERA, r"read .matrix \(3, 3\)"),
    ):
        with pytest.raises(TypeError, match=words):
            np.asarray(expected)
    assert point == PointGoal(3.0, -4.0) and hash(point) == hash(PointGoal(3.0, -4.0))
    assert msgspec.json.encode(point) == b'{"type":"point","x_m":3.0,"y_m":-4.0}'
