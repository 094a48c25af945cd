"""Export the street of a scenario as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import shapely

from cosim.core.errors import unwritable
from cosim.core.progress import Progress, ignore
from cosim.spec.scenario import Scenario
from physics.ground.tiles import tiles_touching
from physics.street.gltf import as_gltf
from scenarios.places.nets import surface_of_place

_AROUND_M: Final = 30.0
"""Largest distance of the written tiles from the route, in metres."""


def export_street(scenario: Scenario, path: Path, progress: Progress = ignore) -> int:
    """Write the tiles along a scenario's route, its fences and its obstacles, as .glb; returns how
    many tiles. y is up, x and -z are the map's x and y, in metres. Raises MachineError when it
    cannot be written."""
    progress(f"reading the street map of {scenario.place.name}")
    surface = surface_of_place(scenario.place)
    keys = tiles_touching(shapely.buffer(shapely.LineString(scenario.route), _AROUND_M))
    written = as_gltf(surface, keys, scenario.barriers, progress, scenario.obstacles)
    try:
        path.write_bytes(written)
    except OSError as error:
        raise unwritable(path, error) from error
    return len(keys)
