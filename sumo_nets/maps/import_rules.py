"""Version and repairs of the importer, and the real places of the benchmark."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

from sumo_nets.maps.levels import settle_levels
from sumo_nets.maps.signal_check import extend_greens, repair_signals
from sumo_nets.net.netconvert import sumo_home

IMPORTER_VERSION: Final = 4
"""Version of the importer, recorded in the description of each imported map. A change that changes
imported nets needs a new version."""

REPAIRS: Final[tuple[Callable[[ET.Element], list[str]], ...]] = (
    settle_levels,
    repair_signals,
    extend_greens,
)
"""Repairs of a finished net, in place and in this order. Each returns its changes, a sentence
each."""


_Box = tuple[float, float, float, float]


class WheelPlace(NamedTuple):
    """A crop of a net.

    net: path below the wheel's tools/game.
    box: west, south, east, north in degrees, None for the whole net.
    osm: drawn from OpenStreetMap data.
    """

    net: str
    box: _Box | None = None
    osm: bool = False

    @property
    def path(self) -> Path:
        """Path of the net in the installed wheel."""
        return sumo_home() / "tools" / "game" / self.net


_BERLIN = "DRT/osm.net.xml"
_BRAUNSCHWEIG = "bs3d/bs.net.xml"
_WILDAU = "A10KW/osm.net.xml"

WHEEL_PLACES: Final[Mapping[str, WheelPlace]] = MappingProxyType(
    {
        "berlin-1": WheelPlace(_BERLIN, (13.5212, 52.4242, 13.5307, 52.4303), osm=True),
        "berlin-2": WheelPlace(_BERLIN, (13.5210, 52.4302, 13.5305, 52.4363), osm=True),
        "berlin-3": WheelPlace(_BERLIN, (13.5309, 52.4243, 13.5404, 52.4304), osm=True),
        "berlin-4": WheelPlace(_BERLIN, (13.5307, 52.4303, 13.5354, 52.4364), osm=True),
        "berlin-5": WheelPlace(_BERLIN, (13.5354, 52.4303, 13.5402, 52.4364), osm=True),
        "berlin-6": WheelPlace(_BERLIN, (13.5406, 52.4244, 13.5500, 52.4305), osm=True),
        "berlin-7": WheelPlace(_BERLIN, (13.5404, 52.4304, 13.5498, 52.4365), osm=True),
        "ingolstadt-1": WheelPlace("fkk_in/ingolstadt.net.xml.gz", osm=True),
        "braunschweig-1": WheelPlace("fokr_bs_demo/fokr_bs.net.xml.gz"),
        "braunschweig-2": WheelPlace(_BRAUNSCHWEIG, (10.5256, 52.2699, 10.5350, 52.2762), osm=True),
        "wildau-1": WheelPlace(_WILDAU, (13.5939, 52.3129, 13.6059, 52.3202), osm=True),
    }
)
"""Crops of nets that the eclipse-sumo wheel installs, by place name. Each is imported on first
use."""
