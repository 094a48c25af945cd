"""Facts of a SUMO net beyond its StreetMap: elevations, levels, signals without green, lanes
shared with cars."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from math import hypot
from pathlib import Path

import shapely

from cosim.core.errors import MapError
from cosim.place.map_check import STEEP_GRADE, NetFacts
from cosim.place.terrain import IMPLAUSIBLE_GRADE
from sumo_nets.net.elevation import off_ground
from sumo_nets.net.net_file import allows
from sumo_nets.net.raw_file import describe_root, net_bytes
from sumo_nets.net.signal_plans import GREEN_LETTERS


def read_facts(path: Path) -> NetFacts:
    """Return the facts of a .net.xml or .net.xml.gz. Raises MapError naming the file and the
    reason."""
    root = net_root(path)
    try:
        return facts_of(root)
    except KeyError as error:
        raise MapError(
            f"{path}: not a street net that can be read: attribute {error} is missing"
        ) from error
    except (ValueError, IndexError, shapely.errors.GEOSException) as error:
        raise MapError(f"{path}: not a street net that can be read: {error}") from error


def net_root(path: Path) -> ET.Element:
    """Parse a net and return its <net> element."""
    data = net_bytes(path)
    try:
        root = ET.fromstring(data)
    except (ET.ParseError, LookupError, ValueError) as error:
        raise MapError(f"{path}: broken XML: {error}") from error
    if root.tag != "net":
        raise MapError(f"{path}: not a SUMO street net: {describe_root(root.tag)}, not <net>")
    return root


def footway(edge: ET.Element) -> tuple[ET.Element, str] | None:
    """Return the lane of an edge for walking, and its kind: "pavement", "shared" with bicycles
    or "mixed" with cars."""
    walked = [lane for lane in edge.iter("lane") if allows(lane.attrib, "pedestrian")]
    apart = next((lane for lane in walked if not allows(lane.attrib, "passenger")), None)
    if apart is not None:
        return apart, "pavement" if apart.get("allow") == "pedestrian" else "shared"
    return (walked[0], "mixed") if walked else None


@dataclass(slots=True)
class _Walks:
    """Crossings by their signals: never green, always green, link beyond the program; and
    signals without a program."""

    never: list[str] = field(default_factory=list)
    always: list[str] = field(default_factory=list)
    misfits: list[str] = field(default_factory=list)
    no_program: list[str] = field(default_factory=list)


def crossing_signals(root: ET.Element) -> _Walks:
    """Classify the crossings of a net by the active signal programs (the last of each signal)."""
    programs = {logic.get("id", ""): logic for logic in root.iter("tlLogic")}
    walks = _Walks()
    for crossing, (signal, link) in crossing_links(root).items():
        if signal not in programs:
            if signal not in walks.no_program:
                walks.no_program.append(signal)
            continue
        states = [phase.get("state", "") for phase in programs[signal].iter("phase")]
        if not states or any(link >= len(state) for state in states):
            walks.misfits.append(crossing)
            continue
        shown = {state[link] for state in states}
        if not shown & GREEN_LETTERS:
            walks.never.append(crossing)
        elif shown <= GREEN_LETTERS:
            walks.always.append(crossing)
    return walks


def crossing_links(root: ET.Element) -> dict[str, tuple[str, int]]:
    """Return the traffic light and link index of each signalised crossing."""
    crossings = {e.get("id", "") for e in root.iter("edge") if e.get("function") == "crossing"}
    links = {}
    for link in root.iter("connection"):
        if "tl" in link.attrib and link.get("to") in crossings:
            with _about(f"connection to '{link.get('to')}'"):
                links[link.get("to", "")] = link.get("tl", ""), int(link.get("linkIndex", "0"))
    return links


def facts_of(root: ET.Element) -> NetFacts:
    """Return the facts of a parsed net. Raises KeyError or ValueError for missing or wrong
    attributes."""
    km: dict[str, float] = defaultdict(float)
    normal = areas = crossings = missing = twisted = steep = false_grades = 0
    heights: list[float] = []
    levels: dict[str, float] = {}
    for edge in root.iter("edge"):
        with _about(f"edge '{edge.get('id', '')}'"):
            function = edge.get("function", "normal")
            areas += function == "walkingarea"
            crossings += function == "crossing"
            if function == "walkingarea":
                twisted += any(_twisted(lane.attrib["shape"]) for lane in edge.iter("lane"))
            if function != "normal":
                continue
            normal += 1
            for lane in edge.iter("lane"):
                heights += [p[2] for p in _points(lane.attrib["shape"]) if len(p) > 2]
            walked = footway(edge)
            if walked is None:
                continue
            lane, kind = walked
            length_m = float(lane.attrib["length"])
            km[kind] += length_m / 1000.0
            if kind == "mixed":
                continue
            missing += "width" not in lane.attrib
            grade = _steepest(lane.attrib["shape"])
            steep += grade > STEEP_GRADE
            false_grades += grade > IMPLAUSIBLE_GRADE
            if off_ground(params_of(edge), edge.get("type", "")):
                levels[edge.attrib["id"]] = length_m / 1000.0
    walks = crossing_signals(root)
    location = root.find("location")
    return NetFacts(
        version=root.get("version", "?"),
        projected=location is not None and location.get("projParameter", "!") not in ("!", "", "-"),
        left_hand=root.get("lefthand") in ("true", "1"),
        edges=normal,
        pavement_km=km["pavement"],
        shared_km=km["shared"],
        mixed_km=km["mixed"],
        areas=areas,
        crossings=crossings,
        twisted_areas=twisted,
        widths_missing=missing,
        signals=len({logic.get("id") for logic in root.iter("tlLogic")}),
        never_green=tuple(walks.never),
        always_green=tuple(walks.always),
        misfits=tuple(walks.misfits),
        no_program=tuple(walks.no_program),
        elevation_m=(min(heights), max(heights)) if heights and any(heights) else None,
        steep=steep,
        false_grades=false_grades,
        levels=tuple(levels),
        levels_km=sum(levels.values()),
    )


@contextmanager
def _about(subject: str) -> Iterator[None]:
    """Add `subject` to the message of an error raised inside."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{subject}: attribute {error} is missing") from error
    except ValueError as error:
        raise ValueError(f"{subject}: {error}") from error


def _points(shape: str) -> list[list[float]]:
    return [[float(v) for v in point.split(",")] for point in shape.split()]


def _twisted(shape: str) -> bool:
    ring = [(p[0], p[1]) for p in _points(shape)]
    return len(ring) > 2 and not shapely.Polygon(ring).is_valid


def _steepest(shape: str) -> float:
    """Return the largest grade between successive points of a lane that have elevations and are
    at least 1 m apart."""
    grades = [0.0]
    for a, b in pairwise(_points(shape)):
        if len(a) > 2 and len(b) > 2:
            apart = hypot(b[0] - a[0], b[1] - a[1])
            grades.append(abs(b[2] - a[2]) / apart if apart >= 1.0 else 0.0)
    return max(grades)


def params_of(edge: ET.Element) -> dict[str, str]:
    """Return the params of an edge by their keys."""
    return {param.get("key", ""): param.get("value", "") for param in edge.findall("param")}
