"""Areas of a scan: found for an import, or replaced in a stored scan."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from cosim.core.errors import MapError, UsageError
from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.place.scan import (
    Georeference,
    HeightGrid,
    ScanArea,
    ScanMesh,
    read_scan,
    write_scan,
)
from cosim.place.scan_areas import (
    corridor,
    cut_to_scan,
    draft_areas,
    fit_to_ground,
    grid_box,
    read_areas,
    read_way,
)
from physics.scans.check import check_areas, check_way
from physics.scans.findings import Finding, note, raise_refusals, warning
from physics.scans.ground import slope
from physics.scans.hidden import behind_walls
from physics.scans.labels import label_mesh
from scenarios.places.scan_options import ScanOptions
from sumo_nets.maps.map_store import About, about_map, map_net, store_map

_ABOUT_AREAS: Final = ("areas:", "holes:", "net:", "way:")
"""First words of findings about areas and their net."""


def find_areas(
    options: ScanOptions,
    mesh: ScanMesh,
    heights: HeightGrid,
    georeference: Georeference | None,
    progress: Progress = ignore,
) -> tuple[tuple[ScanArea, ...], list[Finding]]:
    """Return the areas of a scan, from a file, a map, a walked way, or drafted."""
    if options.areas:
        return read_areas(Path(options.areas), heights, georeference), []
    if options.osm:
        return _mapped(Path(options.osm), heights, georeference, progress)
    if options.way:
        way = read_way(Path(options.way), georeference)
        areas = corridor(way, options.width_m, heights)
        words = f"areas: a corridor of {options.width_m:g} m along {Path(options.way).name}"
        return areas, [note(words), *_way_heights(Path(options.way), way, heights)]
    areas = drafted_areas(mesh, heights)
    size_m2 = sum(area.polygon.area for area in areas)
    return areas, [
        warning(
            f"areas: a draft of {size_m2:.0f} m2 of level ground, in which roads, lawns and "
            "sidewalks are not distinguished, without ground behind walls: edit it "
            "(`cosim scan areas`), or give --areas, --osm or --way"
        )
    ]


def drafted_areas(mesh: ScanMesh, heights: HeightGrid) -> tuple[ScanArea, ...]:
    """Return a draft of the walkable area from the ground.

    Raises MapError if there is too little ground.
    """
    return draft_areas(heights, slope(heights), behind_walls(mesh, heights))


def replace_areas(
    name: str, options: ScanOptions, progress: Progress = ignore
) -> tuple[About, tuple[Finding, ...]]:
    """Replace the areas of a stored scan, and build its net again.

    options: `areas`, `osm`, or `way` and `width_m`; the others have no effect.

    Raises UsageError unless exactly one is given, MapError as an import does. Then nothing changes.
    """
    given = [key for key in ("areas", "osm", "way") if getattr(options, key)]
    if len(given) != 1:
        raise UsageError("give one of --set, --osm and --way")
    progress(f"reading {name}")
    about = about_map(name)
    scan = read_scan(map_net(name).parent)
    progress("finding the walkable area")
    areas, findings = find_areas(
        options, scan.mesh, scan.heights, scan.facts.georeference, progress
    )
    findings += check_areas(areas, scan.heights)
    raise_refusals(findings)

    def fill(ready: Path) -> About:
        from sumo_nets.maps.scan_net import build_scan_net

        net = build_scan_net(areas, scan.heights, scan.facts.georeference, ready, progress)
        findings.extend(note(words) for words in net.findings)
        progress("labelling the mesh")
        mesh = label_mesh(scan.mesh, scan.heights, areas)
        kept = (
            words
            for words in scan.facts.findings
            if not words.removeprefix("warning: ").startswith(_ABOUT_AREAS)
        )
        found = (*kept, *(str(one) for one in findings))
        facts = msgspec.structs.replace(scan.facts, findings=found)
        progress("writing the scan")
        write_scan(dataclasses.replace(scan, facts=facts, areas=areas, mesh=mesh), ready)
        return msgspec.structs.replace(about, changes=found)

    return store_map(name, fill), tuple(findings)


def _mapped(
    path: Path, heights: HeightGrid, georeference: Georeference | None, progress: Progress
) -> tuple[tuple[ScanArea, ...], list[Finding]]:
    """Return the areas of a map, moved to fit the ground."""
    from sumo_nets.maps.scan_osm import osm_areas

    if georeference is None:
        raise MapError(
            f"{path}: a map needs to know where the scan is: import the scan with --georeference "
            "LATITUDE,LONGITUDE"
        )
    reach_m = float(np.abs(grid_box(heights).bounds).max())
    mapped, licences = osm_areas(path, georeference, reach_m, progress)
    moved, fit = fit_to_ground(mapped, heights)
    areas = cut_to_scan(moved, heights)
    words = f"areas: {len(areas)} from {path.name}, {fit}"
    return areas, [note(words), *(note(licence) for licence in licences)]


def _way_heights(path: Path, way: Floats, heights: HeightGrid) -> list[Finding]:
    """Check the heights of a way over the ground, if its file has some."""
    held = msgspec.json.decode(path.read_bytes())
    points = held.get("route", []) if isinstance(held, dict) else []
    if len(points) != len(way) or any(len(point) < 3 for point in points):
        return []
    return check_way(np.array([point[2] for point in points], dtype=float), way, heights)
