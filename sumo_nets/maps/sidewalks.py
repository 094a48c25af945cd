"""Find the sidewalks that the importer guesses, and set their widths."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import Final

from sumo_nets.maps.osm_features import parse_metres
from sumo_nets.net.net_facts import footway

STREET_WIDTHS_M: Final[Mapping[str, float]] = {
    "residential": 2.5,
    "tertiary": 3.0,
    "secondary": 3.3,
    "primary": 3.5,
}
"""Width of a sidewalk by the class of its street, where the map does not give one.

The German RASt 06 (6.1.6.1) has 2.5 m as the standard: 1.8 m for two persons, 0.5 m to the road,
0.2 m to the houses. Their EFA 2002 asks for 3.3 m where homes and shops mix, and NACTO's Urban
Street Design Guide for 2.4 to 3.7 m in business districts. Tertiary and primary streets are
interpolated.
"""
WIDTH_LIMITS_M: Final = 1.0, 10.0
"""Range of the width option, metres; below 1 m a robot and a person cannot pass each other."""
_TAGGED_M: Final = 0.5, 20.0
"""Range of plausible tagged widths, metres; others are ignored."""
_ON_PATHS: Final = frozenset(("pedestrian", "bicycle"))
_CLASS_OF: Final = {"trunk": "primary"}
_CLASS = re.compile(r"highway\.([a-z]+)")


def pavement(edge: ET.Element) -> ET.Element | None:
    """Return the lane of an edge for walking, unless cars share it."""
    walked = None if edge.get("function") else footway(edge)
    return None if walked is None or walked[1] == "mixed" else walked[0]


def pavements(root: ET.Element) -> dict[str, ET.Element]:
    """Return the lanes for walking of a net by edge id, without those that cars share."""
    return {
        edge.get("id", ""): lane
        for edge in root.iter("edge")
        if (lane := pavement(edge)) is not None
    }


def new_share(root: ET.Element, before: Collection[str]) -> float:
    """Return the share of the sidewalks' length on edges outside of `before`."""
    lengths_m = {name: float(lane.get("length", "0")) for name, lane in pavements(root).items()}
    new_m = sum(length_m for name, length_m in lengths_m.items() if name not in before)
    return new_m / max(sum(lengths_m.values()), 1e-9)


def untagged_share(root: ET.Element, tagged: Collection[str]) -> float:
    """Return the share of the walkways' length along roads without an OSM way in `tagged`."""
    total_m = guessed_m = 0.0
    for edge in root.iter("edge"):
        lane = pavement(edge)
        if lane is None:
            continue
        length_m = float(lane.get("length", "0"))
        total_m += length_m
        if len(edge.findall("lane")) > 1 and not set(_way_ids(edge)) & set(tagged):
            guessed_m += length_m
    return guessed_m / max(total_m, 1e-9)


def set_widths(
    root: ET.Element,
    widths_m: Mapping[str, float],
    tagged: Mapping[str, Mapping[str, str]],
    before: Collection[str] = (),
) -> list[str]:
    """Set the widths of guessed sidewalks in place. Return the change, a sentence, or nothing.

    Walkways of edges without lanes for cars are unchanged.

    widths_m: by street class, metres; empty for no change.
    tagged: tags of OSM ways with widths of sidewalks, by way id.
    before: ids of edges whose sidewalks are not guessed.
    """
    if not widths_m:
        return []
    left_hand = root.get("lefthand") in ("true", "1")
    guessed_m = defaultdict[str, float](float)
    tagged_m = 0.0
    for edge in root.iter("edge"):
        lane = pavement(edge)
        if (
            lane is None
            or edge.get("id") in before
            or all(other is lane for other in _vehicle_lanes(edge))
        ):
            continue
        width_m = _tagged_m(edge, tagged, left_hand)
        length_m = float(lane.get("length", "0"))
        if width_m is None:
            kind = street_class(edge)
            width_m = widths_m[kind]
            guessed_m[kind] += length_m
        else:
            tagged_m += length_m
        lane.set("width", f"{width_m:.2f}")
    parts = [
        f"{widths_m[kind]:g} m beside {kind} streets ({guessed_m[kind] / 1000.0:.1f} km)"
        for kind in STREET_WIDTHS_M
        if kind in guessed_m
    ]
    if tagged_m:
        parts.append(f"as tagged beside others ({tagged_m / 1000.0:.1f} km)")
    return [f"sidewalks are {', '.join(parts)}"] if parts else []


def street_class(edge: ET.Element) -> str:
    """Return the class of a street, a key of STREET_WIDTHS_M, from its type or number of lanes."""
    for found in _CLASS.finditer(edge.get("type", "")):
        if (known := _CLASS_OF.get(found[1], found[1])) in STREET_WIDTHS_M:
            return known
    return (
        "secondary"
        if "highway." not in edge.get("type", "") and len(_vehicle_lanes(edge)) > 1
        else "residential"
    )


def _vehicle_lanes(edge: ET.Element) -> list[ET.Element]:
    """Return the lanes of an edge that are not only for people and bicycles."""
    return [
        lane for lane in edge.findall("lane") if set(lane.get("allow", "all").split()) - _ON_PATHS
    ]


def _tagged_m(
    edge: ET.Element, tagged: Mapping[str, Mapping[str, str]], left_hand: bool
) -> float | None:
    """Return the smallest tagged sidewalk width of an edge's ways, metres; None without one."""
    name = edge.get("id", "")
    own = name.lstrip("-").split("#")[0]
    side = "left" if name.startswith("-") != left_hand else "right"
    found = []
    for way in _way_ids(edge):
        if way in tagged:
            # The direction of an edge along its further ways is unknown.
            sides = ("both", side) if way == own else ("both", "left", "right")
            keys = ["sidewalk:width", *(f"sidewalk:{of}:width" for of in sides)]
            known = [parse_metres(tagged[way][key]) for key in keys if key in tagged[way]]
            found += [m for m in known if m is not None and _TAGGED_M[0] <= m <= _TAGGED_M[1]]
    return min(found, default=None)


def _way_ids(edge: ET.Element) -> list[str]:
    """Return the ids of an edge's OSM ways."""
    ids = [param.get("value", "") for param in edge.iter("param") if param.get("key") == "origId"]
    return re.findall(r"\d+", " ".join(ids))
