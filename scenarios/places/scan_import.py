"""Import a scan: read, check and clean it, build its net, and store it as a map."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import MapError
from cosim.core.progress import Progress, ignore
from cosim.place.scan import (
    HeightGrid,
    RecordedMap,
    Scan,
    ScanArea,
    ScanFacts,
    Splats,
    write_scan,
)
from physics.scans.check import (
    check_alignment,
    check_areas,
    check_rotations,
    check_scale,
    check_up,
)
from physics.scans.clean import RULES, clean, walkable_area
from physics.scans.coverage import check_coverage, view_points
from physics.scans.findings import Finding, note, raise_refusals
from physics.scans.ground import closed_holes, height_grid
from physics.scans.labels import label_mesh
from physics.scans.mesh_distance import MeshDistance
from scenarios.places.chosen_areas import find_areas
from scenarios.places.scan_options import ScanOptions
from scenarios.places.scan_sources import LoadedScan, level_hint, load_mesh, load_splats, splat_hint
from sumo_nets.maps.import_rules import IMPORTER_VERSION
from sumo_nets.maps.map_store import About, licence_texts, map_name, store_map

SCAN_IMPORTER: Final = 1
"""Version of the import of scans. It rises when the same files give another result."""
_STEPS_M: Final = ((5_000.0, 0.1), (30_000.0, 0.2), (math.inf, 0.25))
"""Steps of the height grid in metres, by the area of the scan in m2."""


@dataclass(frozen=True, slots=True)
class CheckedScan:
    """Scan that has been read, checked and cleaned. Refusals are among the findings.

    scan: None if a refusal prevented it.
    """

    scan: Scan | None
    findings: tuple[Finding, ...]


def import_scan(
    folder: Path,
    options: ScanOptions,
    progress: Progress = ignore,
    recorded: RecordedMap | None = None,
) -> tuple[About, CheckedScan]:
    """Import the scan in a folder, and store it as a map.

    recorded: hashes of a generated scan of a suite.

    Raises MapError with the first refusal, UsageError for a wrong name. Then nothing is stored.
    """
    name = options.name or map_name(folder.resolve())
    checked = check_scan(folder, options, progress)
    raise_refusals(checked.findings)
    if checked.scan is None:
        raise MapError(f"{folder}: holds no scan")
    scan = checked.scan
    built: list[Finding] = []

    def fill(ready: Path) -> About:
        from sumo_nets.maps.scan_net import build_scan_net

        net = build_scan_net(scan.areas, scan.heights, scan.facts.georeference, ready, progress)
        built.extend(note(words) for words in net.findings)
        progress("writing the scan")
        found = tuple(str(one) for one in (*checked.findings, *built))
        facts = msgspec.structs.replace(scan.facts, name=name, findings=found, recorded=recorded)
        write_scan(dataclasses.replace(scan, facts=facts), ready)
        return _about(name, folder, facts, found, options)

    about = store_map(name, fill)
    return about, CheckedScan(scan, (*checked.findings, *built))


def check_scan(folder: Path, options: ScanOptions, progress: Progress = ignore) -> CheckedScan:
    """Read, check and clean the scan in a folder.

    Raises MapError for files that cannot be read. Later refusals are findings.
    """
    loaded, splat_files = load_mesh(folder, options, progress)
    findings = loaded.findings
    progress("checking axes and scale")
    findings += check_scale(loaded.mesh)
    findings += check_up(loaded.mesh, loaded.up, partial(level_hint, loaded, options))
    if any(one.level == "refused" for one in findings):
        return CheckedScan(None, tuple(findings))
    if splat_files:
        load_splats(loaded, splat_files, options, progress)
    progress("measuring the ground")
    heights = height_grid(loaded.mesh, None, _step_m(loaded))
    findings += _holes(heights)
    progress("finding the walkable area")
    areas, found = find_areas(options, loaded.mesh, heights, loaded.georeference, progress)
    findings += found
    findings += check_areas(areas, heights)
    if any(one.level == "refused" for one in findings):
        return CheckedScan(None, tuple(findings))
    splats, floaters, found = _clean_splats(loaded, heights, areas, options, progress)
    findings += found
    progress("labelling the mesh")
    mesh = label_mesh(loaded.mesh, heights, areas)
    facts = _facts(loaded, options)
    scan = Scan(facts, mesh, heights, areas, splats, floaters)
    return CheckedScan(scan, tuple(findings))


def _holes(heights: HeightGrid) -> list[Finding]:
    holes = closed_holes(heights)
    rows, columns = heights.heights.shape
    return [
        note(
            f"ground: {heights.measured.mean():.0%} of {columns} x {rows} points, "
            f"{heights.step_m:g} m apart, are measured; {holes.count} holes of together "
            f"{holes.area_m2:.0f} m2 are interpolated"
        )
    ]


def _clean_splats(
    loaded: LoadedScan,
    heights: HeightGrid,
    areas: Sequence[ScanArea],
    options: ScanOptions,
    progress: Progress,
) -> tuple[Splats | None, NDArray[np.float32] | None, list[Finding]]:
    """Clean and check the splats. Returns them, the floaters that were removed, and findings."""
    if loaded.splats is None or loaded.raw is None or loaded.splat_matrix is None:
        return None, None, [note("splats: none; pictures show the mesh")]
    progress("removing floaters")
    cleaned = clean(loaded.splats, loaded.mesh, heights, areas)
    findings = [
        note(f"removed {count} splats: {RULES[rule]}")
        for rule, count in cleaned.counts.items()
        if count
    ]
    progress("comparing splats and mesh")
    distance = MeshDistance(loaded.mesh)
    found = check_alignment(cleaned.splats, distance, heights)
    if any(one.level == "refused" for one in found):
        hint = splat_hint(loaded, loaded.raw, options.splat_scale)
        found = check_alignment(cleaned.splats, distance, heights, hint) if hint else found
        return cleaned.splats, cleaned.floaters, findings + found
    findings += found
    if any(name.endswith((".ply", ".ply.gz")) for name in loaded.files):
        findings += check_rotations(loaded.raw, loaded.splat_matrix, options.quaternions, distance)
    progress("measuring the coverage of views")
    eyes = view_points(walkable_area(areas), heights)
    findings += check_coverage(cleaned.splats, eyes)
    return cleaned.splats, cleaned.floaters, findings


def _step_m(loaded: LoadedScan) -> float:
    low, high = loaded.mesh.vertices.min(axis=0), loaded.mesh.vertices.max(axis=0)
    area_m2 = float((high[0] - low[0]) * (high[1] - low[1]))
    return next(step for most, step in _STEPS_M if area_m2 <= most)


def _facts(loaded: LoadedScan, options: ScanOptions) -> ScanFacts:
    return ScanFacts(
        name="",
        files=loaded.files,
        scale=loaded.scale,
        up=loaded.up,
        transform=loaded.matrix,
        splat_transform=loaded.splat_matrix,
        georeference=loaded.georeference,
        sun=options.sun,
        exposure_ev=options.exposure_ev,
        licence=options.licence,
        versions={
            "scan-importer": str(SCAN_IMPORTER),
            **{name: version(name) for name in ("numpy", "scipy", "shapely", "trimesh")},
        },
    )


def _about(
    name: str, folder: Path, facts: ScanFacts, findings: tuple[str, ...], options: ScanOptions
) -> About:
    digest = hashlib.sha256("\n".join(sorted(facts.files.values())).encode()).hexdigest()[:16]
    licences = [options.licence] if options.licence else []
    return About(
        name=name,
        source=folder.resolve().name,
        source_hash=digest,
        format="scan",
        imported_at=datetime.now(UTC).isoformat(timespec="seconds"),
        bbox=None,
        lefthand=None,
        versions={
            "importer": str(IMPORTER_VERSION),
            "scan-importer": str(SCAN_IMPORTER),
            "eclipse-sumo": version("eclipse-sumo"),
        },
        changes=findings,
        guessed_share=None,
        licences=(*licences, *licence_texts(folder)),
        net_hash="",
    )
