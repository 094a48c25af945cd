"""Versions of the importer: what each of them does to a map."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from sumo_nets.maps.levels import settle_levels
from sumo_nets.maps.sidewalks import STREET_WIDTHS_M
from sumo_nets.maps.signal_check import lengthen_walks, mend_signals


@dataclass(frozen=True, slots=True)
class Rules:
    """What one version of the importer does. A change that changes imported nets needs a new
    version.

    version: recorded in the description of each imported map. widths_m: widths of guessed sidewalks
    by street class; empty leaves netconvert's own widths. mends: changes of the finished net, in
    place and in this order; each returns what it changed, a sentence each.
    """

    version: int
    widths_m: Mapping[str, float]
    mends: tuple[Callable[[ET.Element], list[str]], ...]


SUITE_RULES: Final = Rules(3, {}, (mend_signals,))
"""The version that imports the SUMO nets of the shipped places: the suites hold the hashes of these
nets."""
NEWEST_RULES: Final = Rules(4, STREET_WIDTHS_M, (settle_levels, mend_signals, lengthen_walks))
"""The version that imports everything else."""
