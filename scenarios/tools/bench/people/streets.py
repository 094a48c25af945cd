"""Streets to watch people on: a sidewalk round a block that leads back into itself, and a crossing
without signals."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import shapely
from shapely.geometry import Polygon

from cosim.core.geometry import Floats
from cosim.place.street_map import StreetMap
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert

SIDEWALK_WIDTH_M: Final = 3.2
"""The sidewalks' width: five stripes of SUMO's, as most of a city's sidewalks have."""

WINDOW_M: Final = 2.0

_SIDE_M: Final = 30.0
_BUILT: Final = ("--walkingareas", "--offset.disable-normalization", "--junctions.corner-detail=8")


class BlockRing:
    """Four straight sidewalks and four corners, so that whoever walks on comes round again. folder:
    for its net."""

    sides: Final = ("ab", "bc", "cd", "da")
    """Edges, in the order in which one comes to them."""

    middle: Final = (_SIDE_M / 2, _SIDE_M / 2)

    def __init__(self, folder: Path) -> None:
        corners = {
            "a": (0.0, 0.0),
            "b": (_SIDE_M, 0.0),
            "c": (_SIDE_M, _SIDE_M),
            "d": (0.0, _SIDE_M),
        }
        lane = f'<lane index="0" allow="pedestrian" width="{SIDEWALK_WIDTH_M}"/>'
        edges = [_edge(f"{tail}{head}", tail, head, [lane], "center") for tail, head in self.sides]
        self.net = _built(folder, corners, edges, [])

    @cached_property
    def street_map(self) -> StreetMap:
        return read_net(self.net)

    def line(self, side: str) -> Floats:
        """(2, 2) from where to where the middle of a side leads, metres."""
        line = np.asarray(self.street_map.strips[side].line)
        return line[[0, -1]]

    @property
    def area_m2(self) -> float:
        """Of all that is walked on."""
        place = self.street_map
        polygons = [strip.polygon for strip in place.strips.values()]
        return float(
            shapely.area([*polygons, *(corner.polygon for corner in place.corners.values())]).sum()
        )

    def windows(self) -> list[Polygon]:
        """In the middle of each side, WINDOW_M long and as wide as the sidewalk."""
        return [self._stretch(side, WINDOW_M) for side in self.sides]

    def straights(self) -> shapely.Geometry:
        """The four sides without what is near corners."""
        return shapely.union_all([self._stretch(side, _SIDE_M / 2) for side in self.sides])

    def _stretch(self, side: str, length_m: float) -> Polygon:
        start, end = self.line(side)
        middle = (start + end) / 2
        ahead = (end - start) / np.linalg.norm(end - start)
        line = shapely.linestrings([middle - ahead * length_m / 2, middle + ahead * length_m / 2])
        return Polygon(
            shapely.get_coordinates(shapely.buffer(line, SIDEWALK_WIDTH_M / 2, cap_style="flat"))
        )


class OpenCrosswalk:
    """A residential street of two lanes along x, with a marked crossing without signals at x = 0.
    folder: for its net.

    Vehicles come as "wm", "me" and "em", "mw"; people walk along the first of each pair and cross.
    """

    lanes: Final = (("wm", "me"), ("em", "mw"))
    over: Final = (("wm", ":m_c0", "mw"), ("em", ":m_c0", "me"))
    """Walks over the crossing, from either side of the street."""

    half_m: Final = 150.0

    def __init__(self, folder: Path) -> None:
        ends = {"w": (-self.half_m, 0.0), "m": (0.0, 0.0), "e": (self.half_m, 0.0)}
        lanes = [
            f'<lane index="0" allow="pedestrian" width="{SIDEWALK_WIDTH_M}"/>',
            '<lane index="1" disallow="pedestrian" width="3.2"/>',
        ]
        names = [name for pair in self.lanes for name in pair]
        edges = [_edge(name, name[0], name[1], lanes, "right") for name in names]
        crossing = f'<crossing node="m" edges="wm mw" width="{SIDEWALK_WIDTH_M}" priority="true"/>'
        self.net = _built(folder, ends, edges, [crossing])

    @cached_property
    def street_map(self) -> StreetMap:
        return read_net(self.net)


def _edge(name: str, tail: str, head: str, lanes: list[str], spread: str) -> str:
    speed_mps = 8.33
    return (
        f'<edge id="{name}" from="{tail}" to="{head}" numLanes="{len(lanes)}" speed="{speed_mps}" '
        f'spreadType="{spread}">{"".join(lanes)}</edge>'
    )


def _built(
    folder: Path, nodes: dict[str, tuple[float, float]], edges: list[str], crossings: list[str]
) -> Path:
    rows = [
        f'<node id="{name}" x="{x}" y="{y}" type="priority"/>' for name, (x, y) in nodes.items()
    ]
    files = {"nodes": rows, "edges": edges, "connections": crossings}
    options = []
    for (kind, elements), option in zip(files.items(), "nex", strict=True):
        path = folder / f"{kind}.xml"
        path.write_text(f"<{kind}>\n" + "\n".join(elements) + f"\n</{kind}>\n")
        options += [f"-{option}", str(path)]
    return netconvert([*options, *_BUILT], folder / "street.net.xml")
