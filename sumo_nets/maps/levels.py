"""Find streets above and below the ground, from tags and geometry.

OpenStreetMap's `layer` gives the vertical order of crossing ways, and is often set on whole
streets. Alone it is not evidence.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from typing import Final

import shapely

from sumo_nets.net.elevation import GROUND
from sumo_nets.net.net_facts import footway, params_of
from sumo_nets.net.net_file import LANE_M

LEVEL_KEYS: Final = ("bridge", "tunnel", "layer", "covered", "location", "level")
"""Tags of OSM ways that can indicate a level off the ground."""
_GROUND_LAYERS: Final = ("", "0")
_HIDDEN_SHARE: Final = 0.5
"""A walkway with a larger share of its area on roads of another layer lies over or under them."""


def is_levelled(tags: Mapping[str, str]) -> bool:
    """Return whether tags of an OSM way may indicate a level off the ground."""
    raised = any(tags.get(key, "no") not in GROUND for key in ("bridge", "tunnel"))
    return raised or tags.get("layer", "0") not in _GROUND_LAYERS or _on_other_storey(tags)


def edges_of(ways: Mapping[str, int]) -> Iterator[str]:
    """Yield the ids that netconvert may give the edges of OSM ways.

    ways: number of nodes by way id.
    """
    for way, nodes in ways.items():
        for name in (way, *(f"{way}#{part}" for part in range(nodes - 1))):
            yield name
            yield f"-{name}"


def settle_levels(root: ET.Element) -> list[str]:
    """Decide, in place, which edges are off the ground. Return the changes, a sentence each.

    Bridges and tunnels are unchanged. An edge with a level or location off the ground gets a layer.
    An edge with a layer keeps it if it is covered, or if it lies over or under a street of another
    layer. Otherwise it is on the ground.
    """
    normal = [
        edge for edge in root.iter("edge") if not edge.get("function") and len(edge.findall("lane"))
    ]
    params = {edge.get("id", ""): params_of(edge) for edge in normal}
    moved = 0
    doubtful = list[ET.Element]()
    for edge in normal:
        tags = params[edge.get("id", "")]
        if any(tags.get(key, "no") not in GROUND for key in ("bridge", "tunnel")):
            continue
        if _on_other_storey(tags):
            if tags.get("layer", "0") in _GROUND_LAYERS:
                _set_layer(edge, "-1" if tags.get("level", "-1").startswith("-") else "1")
            moved += footway(edge) is not None
        elif tags.get("layer", "0") not in _GROUND_LAYERS and tags.get("covered", "no") == "no":
            doubtful.append(edge)
    stacked = _over_or_under(doubtful, normal, params)
    settled = [edge for edge in doubtful if edge.get("id") not in stacked]
    for edge in settled:
        _set_layer(edge, None)
    walked = sum(footway(edge) is not None for edge in settled)
    changes = []
    if moved:
        changes.append(
            f"{moved} walkways are above or below the ground by their level or location: "
            f"routes avoid them"
        )
    if walked:
        changes.append(
            f"{walked} walkways with a layer are on the ground: no bridge, no tunnel, no "
            f"street over or under them"
        )
    return changes


def _set_layer(edge: ET.Element, layer: str | None) -> None:
    for param in edge.findall("param"):
        if param.get("key") == "layer":
            edge.remove(param)
    if layer is not None:
        ET.SubElement(edge, "param", {"key": "layer", "value": layer})


def _on_other_storey(tags: Mapping[str, str]) -> bool:
    """Return whether level or location indicate another storey than the ground's."""
    if tags.get("location") in ("underground", "overhead"):
        return True
    try:
        levels = [float(part) for part in tags.get("level", "0").split(";")]
    except ValueError:
        return False
    return all(level > 0.0 for level in levels) or all(level < 0.0 for level in levels)


def _over_or_under(
    doubtful: list[ET.Element], normal: list[ET.Element], params: Mapping[str, Mapping[str, str]]
) -> set[str]:
    """Return the ids of edges that cross a street of another layer, or lie mostly over or under
    such streets."""
    others = [
        edge
        for edge in normal
        if any(lane.get("allow") != "pedestrian" for lane in edge.findall("lane"))
    ]
    if not doubtful or not others:
        return set()
    lines = [_line(edge.findall("lane")[-1]) for edge in others]
    tree = shapely.STRtree(lines)
    found = set[str]()
    roads = shapely.STRtree([_ground(edge) for edge in others])
    for edge in doubtful:
        name = edge.get("id", "")
        ends = {edge.get("from"), edge.get("to")}
        layer = params[name]["layer"]
        line = _line(edge.findall("lane")[0])
        ground = _ground(edge)
        crossed = [others[k] for k in tree.query(line, predicate="crosses")]
        touched = [
            (others[k], roads.geometries[k]) for k in roads.query(ground, predicate="intersects")
        ]
        # Streets that meet at a junction may overlap there.
        under = [
            area
            for other, area in touched
            if _layer(params[other.get("id", "")]) != layer
            and not ends & {other.get("from"), other.get("to")}
        ]
        hidden_m2 = shapely.area(shapely.intersection(shapely.union_all(under), ground))
        if hidden_m2 > _HIDDEN_SHARE * shapely.area(ground) or any(
            _layer(params[other.get("id", "")]) != layer for other in crossed
        ):
            found.add(name)
    return found


def _layer(tags: Mapping[str, str]) -> str:
    """Return the layer of an edge; a bridge or tunnel without one has a layer of its own."""
    for key in ("bridge", "tunnel"):
        if tags.get(key, "no") not in GROUND:
            return tags.get("layer", key)
    return tags.get("layer", "0")


def _line(lane: ET.Element) -> shapely.LineString:
    points = [[float(v) for v in point.split(",")[:2]] for point in lane.get("shape", "").split()]
    return shapely.LineString(points)


def _ground(edge: ET.Element) -> shapely.Geometry:
    """Return the ground that an edge covers."""
    lanes = [(_line(lane), float(lane.get("width", LANE_M))) for lane in edge.findall("lane")]
    return shapely.union_all(
        [shapely.buffer(line, width_m / 2.0, cap_style="flat") for line, width_m in lanes]
    )
