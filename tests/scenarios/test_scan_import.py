"""Import of scans: faulty inputs, the order of files, real scans, and the command line."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import trimesh
from numpy.typing import NDArray

from cosim.cli.scan import ScanChoices
from cosim.core.errors import CosimError
from cosim.core.state import LABELS
from cosim.place.scan import RecordedMap, ScanArea, encode_areas, read_scan
from cosim.place.scan_areas import read_way
from cosim.spec.scenario import City
from physics.scans.check import lattice_points
from physics.scans.clean import above_ground, walkable_area
from physics.scans.frame import Placing
from scenarios.places import scan_sources
from scenarios.places.nets import place
from scenarios.places.scan_import import CheckedScan, check_scan, import_scan
from scenarios.places.scan_make import crossing_box, make_scan
from scenarios.places.scan_options import ScanOptions, parse_georeference, read_options
from scenarios.suites.decoys import limited
from scenarios.suites.proofs import Proof
from scenarios.suites.sample import suite_on_map
from scenarios.tools.build.proving import proved
from sumo_nets.maps.ground_file import ground_hash
from sumo_nets.maps.map_store import map_hash, maps_folder, read_map
from sumo_nets.net.raw_file import net_content_hash
from tests.conftest import Cosim
from tests.support.documents import blocks, text_of
from tests.support.moved_scenarios import moved_scenario
from tests.support.scans import (
    LENGTH_M,
    Street,
    gaussian_ply,
    glb,
    splats_of,
    street,
    write_street,
)

SHARED = Path(os.environ.get("COSIM_SHARED", Path(__file__).parents[3] / "shared")) / "scans"
GIVEN: dict[str, Any] = {"splat_scale": 1.0, "splat_up": "+z"}
Spoil = Callable[[Path], dict[str, Any] | None]


@pytest.fixture(scope="module")
def good_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a valid scan, to be copied."""
    folder = write_street(tmp_path_factory.mktemp("scans") / "street")
    _draw(folder, [("sidewalk", (1, -4, LENGTH_M - 1, -1))])
    return folder


@pytest.fixture
def scan(good_scan: Path, tmp_path: Path) -> Path:
    """Return a copy of the valid scan."""
    return Path(shutil.copytree(good_scan, tmp_path / "street"))


def _draw(folder: Path, areas: list[tuple[str, tuple[float, ...]]]) -> None:
    """Write areas.geojson with boxes, in metres."""
    features = [
        {
            "type": "Feature",
            "properties": {"kind": kind},
            "geometry": shapely.geometry.mapping(shapely.box(*box)),
        }
        for kind, box in areas
    ]
    collection = {"type": "FeatureCollection", "frame": "local", "features": features}
    (folder / "areas.geojson").write_text(json.dumps(collection))


def _check(folder: Path, **given: Any) -> CheckedScan:
    given = {"areas": str(folder / "areas.geojson"), **GIVEN, **given}
    return check_scan(folder, read_options(folder, given))


def _words(folder: Path, **given: Any) -> list[str]:
    """Return the findings of a scan, or its error."""
    try:
        return [str(one) for one in _check(folder, **given).findings]
    except CosimError as error:
        return [f"refused: {error}"]


def test_a_valid_scan_passes_all_checks(scan: Path) -> None:
    """The only warning is of the coverage, which a single street lacks, and no splat is removed."""
    checked = _check(scan)
    levels = {one.level for one in checked.findings if "coverage" not in one.words}
    assert levels == {"note"}
    assert checked.scan is not None
    assert checked.scan.splats is not None
    assert len(checked.scan.splats) == 12_000
    assert checked.scan.floaters is not None
    assert len(checked.scan.floaters) == 0
    share = checked.scan.splats.ground.mean()
    assert share == pytest.approx(LENGTH_M * 12 / (LENGTH_M * 15 + 13.6), abs=0.05)
    labels = set(checked.scan.mesh.labels.tolist())
    assert {LABELS[name] for name in ("sidewalk", "ground", "building", "prop")} == labels


def _bytes(name: str, data: bytes) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return spoil


def _cut(name: str, share: float) -> Spoil:
    def spoil(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return spoil


def _mesh(change: Callable[[Street], Street], **given: Any) -> Spoil:
    def spoil(folder: Path) -> dict[str, Any]:
        (folder / "mesh.glb").write_bytes(glb(change(street())))
        (folder / "splats.ply").unlink()
        return {"splat_scale": None, "splat_up": None, **given}

    return spoil


def _cloud(change: Callable[[Any], None], **given: Any) -> Spoil:
    def spoil(folder: Path) -> dict[str, Any]:
        cloud = splats_of(street())
        change(cloud)
        (folder / "splats.ply").write_bytes(gaussian_ply(cloud))
        return given

    return spoil


def _turned(degrees: float) -> Callable[[Street], Street]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return lambda place: place.moved(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))


def _set(field: str, rows: Any, value: Any) -> Callable[[Any], None]:
    def change(cloud: Any) -> None:
        getattr(cloud, field)[rows] = value

    return change


def _move(offset: tuple[float, ...], scale: float = 1.0) -> Callable[[Any], None]:
    def change(cloud: Any) -> None:
        cloud.centres = cloud.centres * scale + offset

    return change


def _without(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).unlink()

    return spoil


def _as_ply(folder: Path) -> dict[str, Any]:
    """Write the mesh as .ply, which states neither unit nor axes, in centimetres."""
    street().moved(100.0 * np.eye(3)).mesh().export(folder / "mesh.ply")
    (folder / "mesh.glb").unlink()
    return {}


def _drawn(*areas: tuple[str, tuple[float, ...]]) -> Spoil:
    def spoil(folder: Path) -> None:
        _draw(folder, list(areas))

    return spoil


def _punched(folder: Path) -> dict[str, Any]:
    """Write a mesh without ground at x from 10 to 14."""
    place = street()
    middle = place.vertices[place.triangles].mean(axis=1)
    hole = (np.abs(middle[:, 0] - 12) < 2) & (middle[:, 2] < 0.01)
    place.triangles = place.triangles[~hole]
    (folder / "mesh.glb").write_bytes(glb(place))
    return {}


def _wrong_way(folder: Path) -> dict[str, Any]:
    way = [[x, -2.5, 10.0] for x in range(2, 28)]
    (folder / "way.json").write_text(json.dumps({"route": way}))
    return {"areas": None, "way": str(folder / "way.json"), "width_m": 2.0}


def _given(**given: Any) -> Spoil:
    return lambda folder: given


def _transform(rows: list[list[float]]) -> Spoil:
    return _given(transform=tuple(map(tuple, rows)))


def _nan_mesh(folder: Path) -> None:
    place = street()
    place.vertices[::20, 1] = np.nan
    (folder / "mesh.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in place.vertices)
        + "".join(f"f {a} {b} {c}\n" for a, b, c in place.triangles + 1)
    )
    (folder / "scan.json").write_text('{"files": ["mesh.obj"], "scale": 1, "up": "+z"}')


def _system(crs: str) -> Placing:
    return Placing(crs=crs)


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 14990961\n"
SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

BAD: dict[str, tuple[Spoil, str]] = {
    "lfs": (_bytes("mesh.glb", POINTER), r"Git LFS pointer of \d+ bytes.*git lfs pull"),
    "lfs-splats": (_bytes("splats.ply", POINTER), "Git LFS pointer.*git lfs pull"),
    "html": (_bytes("mesh.glb", b"<!DOCTYPE html><p>"), "a web page of 18 bytes.*browser"),
    "empty": (_bytes("splats.ply", b""), "an empty file: export"),
    "cut-mesh": (_cut("mesh.glb", 0.7), r"cut off: \d+ of \d+ bytes.*download"),
    "cut-splats": (_cut("splats.ply", 0.7), r"promises 12000 splats.*enough for 83\d\d"),
    "no-mesh": (_without("mesh.glb"), "1 files of splats and 0 meshes: export the scan also"),
    "nan-mesh": (_nan_mesh, r"triangles \(\d+\.\d%\) have NaN.*at most 1%"),
    "nan-splats": (
        _cloud(_set("centres", slice(0, None, 50), np.nan)),
        r"240 of 12000 splats \(2\.0%\) have NaN.*at most 1%.*train or export again",
    ),
    "few-nan": (
        _cloud(_set("centres", slice(0, 7), np.inf)),
        "warning: .*7 of 12000 splats with NaN, infinite or zero numbers dropped",
    ),
    "up": (_given(up="-y"), r"up: the ground's normal is 180 degrees off.*try --up \+y"),
    "up-z": (_given(up="+z"), r"is 90 degrees off the stated up axis \+z.*try --up \+y"),
    "tilt": (_mesh(_turned(12.0)), r"is 12 degrees off.*at most 5.*level the scan"),
    "unstated": (_as_ply, r"scale and up must be given.*likely: --up \+z.*3000 m long"),
    "small": (
        _given(scale=0.01),
        r"scale: the scan is 0\.3 m long.*5 to 3000 m.*--scale 100 .*would fit",
    ),
    "large": (
        _mesh(lambda p: p.moved(1000 * np.eye(3))),
        r"scale: the scan is 3e\+04 m long.*--scale 0\.01 or --scale 0\.001 would fit",
    ),
    "mirrored": (
        _mesh(lambda p: p.moved(np.diag([1.0, -1.0, 1.0]))),
        "mirrored: the fronts of 100% of the ground's triangles face down.*--mirror x.*--flip",
    ),
    "mirror-matrix": (_transform(MIRRORED), "it mirrors: its determinant is -1"),
    "shear": (_transform(SHEARED), r"columns 1 and 2 have the product 0\.500.*shears"),
    "both": (
        _given(transform=tuple(map(tuple, np.eye(4).tolist())), scale=2.0),
        "transform replaces scale, up and mirror",
    ),
    "crs": (
        lambda folder: {
            "georeference": _system("EPSG:1"),
        },
        "'EPSG:1' is no coordinate system: give one such as EPSG:25833",
    ),
    "beside": (
        _cloud(_move((0.0, 1.0, 0.0))),
        r"splats lie 1\.\d m beside the mesh: \d+% .* after a shift by \(.*, -1\.0, .*--splat-trans",
    ),
    "above": (_cloud(_move((0.0, 0.0, 0.5))), r"lie 0\.[45] m beside the mesh"),
    "slightly-above": (
        _cloud(_move((0.0, 0.0, 0.07))),
        r"warning: ground splats are 0\.070 m over the mesh's ground",
    ),
    "other-scale": (_cloud(_move((0.0, 0.0, 0.0), 10.0)), "splats.*give --splat-scale"),
    "splat-up": (
        _given(splat_up="-y"),
        r"different frames.*--splat-scale 1 --splat-up \+z fits: \d+% within 0\.15 m",
    ),
    "splat-unstated": (
        _given(splat_scale=None, splat_up=None),
        r"splat_scale and splat_up must be given.*--splat-scale 1 --splat-up \+z fits",
    ),
    "floaters": (
        _cloud(_set("centres", slice(0, 40), [15.0, -2.5, 1.0])),
        r"removed 40 splats: 0\.15 to 2 m above free walkable ground",
    ),
    "faint": (_cloud(_set("rgba", (slice(0, 30), 3), 0.01)), "removed 30 splats: opacity under"),
    "huge": (_cloud(_set("scales", slice(0, 3), 5.0)), "removed 3 splats: over 2 m in size"),
    "alone": (_cloud(_set("centres", 0, [15, 0, 9])), "removed 1 splats: fewer than 3 neighb"),
    "below": (_cloud(_set("centres", slice(0, 9), [15, 0, -1])), r"removed 9 .* below the ground"),
    "sky": (
        _cloud(_set("centres", slice(0, 9), [900, 0, 99])),
        "removed 9 splats: over 300 m from the mesh: sky",
    ),
    "thin": (
        _cloud(_set("rgba", (slice(0, None, 2), 3), 0.2)),
        r"warning: coverage: \d+% of the view below the horizon is opaque.*98% should be",
    ),
    "holes": (_punched, r"warning: holes: 8\d\.\d% of the walkable area has measured ground"),
    "no-area": (_drawn(("road", (1, -4, 20, -1))), "no walkable area among 1 areas: draw"),
    "no-ground": (
        lambda folder: (_punched(folder), _draw(folder, [("sidewalk", (10.2, -4, 13.8, -1))]))[0],
        r"only \d+% of area 0 \(sidewalk\) has ground in the scan; at least 50%",
    ),
    "far-area": (_drawn(("sidewalk", (90, 0, 99, 3))), "outside of the scan"),
    "way": (_wrong_way, r"way: it is 10\.00 m over the ground \(median\).*-0\.3 to 3 m"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_scan_is_described_in_one_line(scan: Path, name: str) -> None:
    """Each fault gives one line with the measured value and, where the scan is refused, a
    remedy."""
    spoil, wanted = BAD[name]
    lines = _words(scan, **(spoil(scan) or {}))
    found = [words for words in lines if re.search(wanted, words)]
    assert len(found) == 1, lines
    assert "\n" not in found[0]
    if not found[0].startswith(("warning", "removed")):
        assert found[0].startswith("refused: ")


def test_too_many_splats_are_refused_and_reduced_by_option(
    scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names the limit and the option that reduces splats, which drops the least visible
    ones."""
    monkeypatch.setattr(scan_sources, "BUDGET", 10_000)
    (words,) = _words(scan)
    assert "12000 splats; at most 10000 are imported: reduce them with --most-splats 5000" in words
    cloud = splats_of(street())
    cloud.rgba[:7000, 3] = 0.6
    (scan / "splats.ply").write_bytes(gaussian_ply(cloud))
    checked = _check(scan, most_splats=5000)
    assert checked.scan is not None
    assert checked.scan.splats is not None
    assert len(checked.scan.splats) == 5000
    assert checked.scan.splats.rgba[:, 3].min() == round(0.9 * 255)


def test_rotations_in_another_order_are_noticed(scan: Path) -> None:
    """Flat splats that are read in the wrong order do not lie along the mesh."""
    cloud = splats_of(street())
    (scan / "splats.ply").write_bytes(gaussian_ply(cloud, order="xyzw"))
    assert any("try --quaternions xyzw" in words for words in _words(scan))
    lines = _words(scan, quaternions="xyzw")
    assert lines and not any("--quaternions" in words for words in lines)
    assert _refused(lines) == []


def test_mirrored_and_flipped_meshes_are_repaired_by_option(scan: Path) -> None:
    """--mirror gives the mesh of the unmirrored file, and --flip turns only its triangles."""
    (scan / "splats.ply").unlink()
    wanted = _check(scan).scan
    assert wanted is not None
    mirrored = street().moved(np.diag([-1.0, 1.0, 1.0]))
    (scan / "mesh.glb").write_bytes(glb(mirrored))
    found = _check(scan, mirror="x").scan
    assert found is not None
    assert np.array_equal(found.mesh.vertices, wanted.mesh.vertices)
    assert np.array_equal(found.mesh.triangles, wanted.mesh.triangles)
    place = street()
    place.triangles = place.triangles[:, ::-1]
    (scan / "mesh.glb").write_bytes(glb(place))
    flipped = _check(scan, flip=True).scan
    assert flipped is not None
    assert np.array_equal(flipped.mesh.triangles, wanted.mesh.triangles)


@pytest.mark.engine
def test_the_order_of_rows_changes_no_stored_bit(scan: Path, tmp_path: Path) -> None:
    """Shuffled triangles, vertices and splats, split over several files and read on one processor,
    have the same hashes. A changed splat changes only the hash of splats."""
    options = read_options(scan, {"areas": str(scan / "areas.geojson"), **GIVEN, "name": "scan-a"})
    import_scan(scan, options)
    random = np.random.default_rng(3)
    place, cloud = street(), splats_of(street())
    other = tmp_path / "other"
    other.mkdir()
    rows = random.permutation(len(place.vertices))
    triangles = np.argsort(rows)[place.triangles[random.permutation(len(place.triangles))]]
    for k in range(2):
        part = Street(place.vertices[rows], triangles[k::2], place.colours[rows])
        (other / f"{k}.glb").write_bytes(glb(part))
    order = random.permutation(12_000)
    (other / "b.ply").write_bytes(gaussian_ply(cloud.taken(order[:5000])))
    (other / "c.ply").write_bytes(gaussian_ply(cloud.taken(order[5000:])))
    cpus = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cpus)})
    try:
        import_scan(other, read_options(other, {**_given_of(options), "name": "scan-b"}))
    finally:
        os.sched_setaffinity(0, cpus)
    one, two = (read_scan(maps_folder() / name).facts for name in ("scan-a", "scan-b"))
    for name in ("mesh_hash", "splats_hash", "heights_hash", "areas_hash"):
        assert getattr(one, name) == getattr(two, name)
    assert read_map("scan-a").net_hash == read_map("scan-b").net_hash
    cloud.rgba[17, 0] += 0.1
    (scan / "splats.ply").write_bytes(gaussian_ply(cloud))
    import_scan(scan, options)
    changed = read_scan(maps_folder() / "scan-a").facts
    assert changed.splats_hash != one.splats_hash
    assert read_map("scan-a").net_hash == read_map("scan-b").net_hash


@pytest.mark.engine
def test_a_scan_with_the_recorded_ground_has_the_recorded_hash(scan: Path) -> None:
    """Another colour of its mesh does not matter, and another ground or a changed net does."""
    (scan / "splats.ply").unlink()
    options = read_options(scan, {"areas": str(scan / "areas.geojson"), "name": "scan-a"})
    import_scan(scan, options)
    folder = maps_folder() / "scan-a"
    own, ground = (
        read_map("scan-a").net_hash,
        ground_hash(net_content_hash(folder / "net.xml"), folder),
    )
    import_scan(scan, options, recorded=RecordedMap("0123456789abcdef", "f" * 16))
    assert read_map("scan-a").net_hash == own
    place = street()
    place.colours[0] = 255 - place.colours[0]
    (scan / "mesh.glb").write_bytes(glb(place))
    import_scan(scan, options)
    assert read_map("scan-a").net_hash != own
    import_scan(scan, options, recorded=RecordedMap("0123456789abcdef", ground))
    assert read_map("scan-a").net_hash == map_hash(folder / "net.xml") == "0123456789abcdef"
    net = (folder / "net.xml").read_text()
    (folder / "net.xml").write_text(net.replace('speed="', 'speed="1', 1))
    assert map_hash(folder / "net.xml") not in (own, "0123456789abcdef")


def _given_of(options: Any) -> dict[str, Any]:
    return {"areas": options.areas, **GIVEN}


@pytest.mark.engine
def test_a_generated_street_is_recovered_from_a_corrupted_export(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """An export in centimetres, y up, turned by 33 degrees, at UTM coordinates, with noise and lost
    triangles keeps heights, areas and paths. The oracle solves the same scenario within the limit
    of the clean scan, two with --whole."""
    clean = tmp_path / "clean"
    city = City(seed=7, size_m=300.0)
    x0, y0, x1, y1 = crossing_box(place(city)[1])
    make_scan(city, (x0 + 20, y0 + 14, x1 - 20, y1 - 14), clean, spacing_m=0.5)
    wanted = import_scan(clean, read_options(clean, {"name": "scan-clean"}))[1].scan
    assert wanted is not None
    angle = np.radians(33)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    offset = np.array([391_000.0, 5_820_000.0, 34.0])
    y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    random = np.random.default_rng(5)
    mesh = wanted.mesh
    noisy = mesh.vertices + random.normal(0, 0.03, mesh.vertices.shape)
    exported = ((noisy @ turn.T + offset) * 100.0) @ y_up.T
    rows = random.random(len(mesh.triangles)) > 0.05
    folder = tmp_path / "spoiled"
    folder.mkdir()
    _write_ply(folder / "mesh.ply", exported, mesh.triangles[rows], mesh.colours)
    given = {"scale": 0.01, "up": "+y", "georeference": _system("EPSG:25833")}
    matrix = np.array(scan_sources.load_mesh(folder, read_options(folder, given))[0].matrix)

    def to_net(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        world = (np.column_stack([xy, np.zeros(len(xy))]) @ turn.T + offset) @ y_up.T * 100.0
        return (np.column_stack([world, np.ones(len(xy))]) @ matrix.T)[:, :2]

    areas = [ScanArea(area.kind, shapely.transform(area.polygon, to_net)) for area in wanted.areas]
    (folder / "areas.geojson").write_bytes(encode_areas(areas))
    given |= {"areas": str(folder / "areas.geojson"), "name": "scan-spoiled"}
    _, checked = import_scan(folder, read_options(folder, given))
    assert checked.scan is not None
    walked = walkable_area(wanted.areas)
    xy = lattice_points(walked.buffer(-0.3), 0.7)
    before, known = above_ground(wanted.heights, np.column_stack([xy, np.zeros(len(xy))]))
    after, still = above_ground(
        checked.scan.heights, np.column_stack([to_net(xy), np.zeros(len(xy))])
    )
    error = (before - after)[known] - (34.0 + matrix[2, 3])
    assert still[known].mean() > 0.9  # the rest is interpolated
    assert abs(np.median(error)) < 0.01
    assert np.quantile(np.abs(error), 0.9) < 0.03
    found = read_map("scan-spoiled")
    walkable = shapely.union_all(
        [piece.polygon for piece in (*found.strips.values(), *found.corners.values())]
    )
    moved = shapely.transform(walked, to_net)
    both = shapely.intersection(walkable, moved).area
    assert both / shapely.union(walkable, moved).area > 0.95
    assert moved.length == pytest.approx(walked.length, rel=0.01)
    count = 2 if request.config.getoption("--whole") else 1
    for scenario in suite_on_map("unit", "scan-clean", 0, count).scenarios:
        exact = proved(scenario)
        assert isinstance(exact, Proof), exact
        shown = limited(scenario, exact.time_s, exact.passing_mps)
        spoiled = proved(moved_scenario(shown, "scan-spoiled", found, to_net))
        assert isinstance(spoiled, Proof), spoiled


def _write_ply(
    path: Path,
    vertices: NDArray[np.float64],
    triangles: NDArray[np.int32],
    colours: NDArray[np.uint8],
) -> None:
    """Write a binary .ply with doubles."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        + "".join(f"property double {name}\n" for name in "xyz")
        + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        + f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(vertices), [("at", "<f8", 3), ("colour", "u1", 3)])
    rows["at"], rows["colour"] = vertices, colours
    faces = np.zeros(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    path.write_bytes(head.encode() + rows.tobytes() + faces.tobytes())


@pytest.mark.engine
def test_the_command_line_imports_checks_and_shows(
    cosim: Cosim, scan: Path, tmp_path: Path
) -> None:
    """Options come from scan.json, the picture shows the areas, and wrong input ends with 2."""
    (scan / "scan.json").write_text(
        json.dumps(
            {"splat_scale": 1.0, "splat_up": "+z", "areas": "areas.geojson", "licence": "CC0"}
        )
    )
    done = cosim("scan", "import", str(scan), "--name", "scan-cli")
    assert done.returncode == 0, done.stderr
    assert "Stored as 'scan-cli'" in done.stdout
    assert "12000 splats" in done.stdout
    picture = tmp_path / "scan.png"
    shown = cosim("scan", "show", "scan-cli", "-o", str(picture))
    assert shown.returncode == 0, shown.stderr
    assert picture.stat().st_size > 5000
    written = cosim("scan", "areas", "scan-cli", "-o", str(tmp_path / "out.geojson"))
    assert written.returncode == 0, written.stderr
    assert json.loads((tmp_path / "out.geojson").read_text())["features"]
    listed = cosim("map", "check", "scan-cli")
    assert "CC0" in listed.stdout + listed.stderr
    refused = cosim("scan", "check", str(scan), "--up", "-y", "--json")
    assert refused.returncode == 2
    assert [row["level"] for row in json.loads(refused.stdout)].count("refused") == 1
    (scan / "scan.json").write_text('{"scale": -1, "upp": "+z"}')
    wrong = cosim("scan", "check", str(scan))
    assert wrong.returncode == 2
    assert "scale" in wrong.stderr
    assert "upp" in wrong.stderr
    assert cosim("scan", "show", "nowhere").returncode == 2


@pytest.mark.engine
@pytest.mark.skipif(not SHARED.is_dir(), reason="no shared scans beside the repository")
def test_a_street_in_lund_is_imported(tmp_path: Path) -> None:
    """The walked path lies on its ground; the splats agree with the mesh and lack coverage."""
    for name in ("lund_street_ground.glb", "lund_street_obstacles.glb"):
        shutil.copy(SHARED / "lund-street" / name, tmp_path)
    shutil.copy(SHARED / "lund-street-splats" / "lund_street.ply", tmp_path)
    way = SHARED / "lund-street" / "lund_street_route.json"
    options = read_options(tmp_path, {**GIVEN, "way": str(way), "width_m": 3.0, "name": "lund"})
    about, checked = import_scan(tmp_path, options)
    words = " ".join(str(one) for one in checked.findings)
    assert "way: it is 0.00 m over the ground" in words
    assert "warning: coverage" in words
    assert checked.scan is not None
    assert len(checked.scan.mesh.triangles) == 136_904
    assert read_map(about.name).strips


def test_the_documented_options_are_those_of_the_import(tmp_path: Path) -> None:
    """The documented scan.json and path are read, and the table names every key and option."""
    options, path = blocks("json", "docs/scans.md")
    (tmp_path / "scan.json").write_text(options.text)
    (tmp_path / "walk.geojson").write_text(path.text)
    assert read_way(tmp_path / "walk.geojson", None).tolist() == [[-12, 3], [-22, 9]]
    assert read_options(tmp_path, {}).splat_up == "+z"
    text = text_of("docs/scans.md")
    for name in ScanOptions.__struct_fields__:
        assert f"`{name}`" in text, name
    for name in (field.name for field in dataclasses.fields(ScanChoices)):
        flag = f"--{name.replace('_', '-')}"
        assert flag in text or name.startswith("splat_"), flag


@pytest.mark.skipif(not SHARED.is_dir(), reason="no shared scans beside the repository")
def test_trained_splats_in_a_wrong_frame_are_refused(tmp_path: Path) -> None:
    """The trained splats of Lund are in metres, and the transform of its photos does not fit
    them."""
    for name in ("lund_street_ground.glb", "lund_street_obstacles.glb"):
        shutil.copy(SHARED / "lund-street" / name, tmp_path)
    trained = SHARED / "lund-street-trained"
    shutil.copy(trained / "splats.ply", tmp_path)
    way = {"way": str(SHARED / "lund-street" / "lund_street_route.json")}
    wrong = {**way, "splat_transform": str(trained / "transform.json")}
    (words,) = (
        one.words
        for one in check_scan(tmp_path, read_options(tmp_path, wrong)).findings
        if one.level == "refused"
    )
    assert "--splat-scale 1 --splat-up +z fits" in words
    found = check_scan(tmp_path, read_options(tmp_path, {**GIVEN, **way}))
    by_level = {one.level: [] for one in found.findings}
    for one in found.findings:
        by_level[one.level].append(one.words)
    assert "refused" not in by_level
    assert "removed 5109 splats: over 300 m from the mesh" in " ".join(by_level["note"])
    warned = " ".join(by_level["warning"])
    assert "splats to mesh: 0.0" in warned
    assert "coverage" in warned


@pytest.mark.engine
def test_areas_come_from_openstreetmap_through_the_georeference(tmp_path: Path) -> None:
    """Around a crossing of the village, roads and sidewalks are where its nodes are, and the net is
    built."""
    side = np.linspace(-45, 45, 181)
    x, y = (one.ravel() for one in np.meshgrid(side, side, indexing="ij"))
    at = (np.arange(180)[:, None] * 181 + np.arange(180)).ravel()
    faces = np.concatenate(
        [np.column_stack([at, at + 181, at + 182]), np.column_stack([at, at + 182, at + 1])]
    )
    ground = np.column_stack([x, y, np.zeros(len(x))])
    (tmp_path / "mesh.glb").write_bytes(
        glb(Street(ground, faces, np.full((len(x), 3), 120, np.uint8)))
    )
    village = files("scenarios") / "examples" / "village.osm"
    given = {"georeference": parse_georeference("52.5011,13.4017"), "osm": str(village)}
    _, checked = import_scan(tmp_path, read_options(tmp_path, {**given, "name": "scan-osm"}))
    assert checked.scan is not None
    of_kind = {
        kind: shapely.union_all([a.polygon for a in checked.scan.areas if a.kind == kind])
        for kind in ("road", "sidewalk", "crossing")
    }
    # Market Street runs along x = 0, Second Street along y = 0.
    for point in ((0, 30), (0, -30), (30, 0), (-30, 0)):
        assert of_kind["road"].buffer(0.5).contains(shapely.Point(point))
    assert 4 * 60 < of_kind["sidewalk"].area < 2500
    assert of_kind["crossing"].area > 20
    kinds = {strip.kind for strip in read_map("scan-osm").strips.values()}
    assert kinds == {"sidewalk", "crossing"}
    assert "OpenStreetMap" in " ".join(str(one) for one in checked.findings)


def test_a_heading_turns_the_scan_to_north(tmp_path: Path) -> None:
    """Without a heading the finding states the assumed one and the remedy. With a heading, +y of
    the scan points there; a coordinate system has no heading."""
    (tmp_path / "mesh.glb").write_bytes(glb(street()))

    def loaded(words: str) -> scan_sources.LoadedScan:
        given = {"georeference": parse_georeference(words)}
        return scan_sources.load_mesh(tmp_path, read_options(tmp_path, given))[0]

    plain, stated, east = (loaded(f"55.698,13.195{rest}") for rest in ("", ",0", ",90"))
    assumed = [one.words for one in plain.findings if "is taken as north, heading 0" in one.words]
    assert len(assumed) == 1 and "third number of --georeference" in assumed[0]
    assert not any("taken as north" in one.words for one in (*stated.findings, *east.findings))
    assert np.array_equal(plain.mesh.vertices, stated.mesh.vertices)
    turn = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    turned = np.array(sorted((plain.mesh.vertices @ turn.T).round(4).tolist()))
    assert np.array(sorted(east.mesh.vertices.round(4).tolist())) == pytest.approx(turned, abs=1e-3)
    with pytest.raises(CosimError, match=r"heading_deg is 720, but must be -360 to 360"):
        loaded("55.698,13.195,720")
    (tmp_path / "scan.json").write_text('{"georeference": {"crs": "EPSG:25833", "heading_deg": 3}}')
    with pytest.raises(CosimError, match="EPSG:25833 has its own north: leave it out"):
        scan_sources.load_mesh(tmp_path, read_options(tmp_path, {}))


@pytest.mark.parametrize("heading", ["", ",33"])
def test_the_remedy_of_a_tilted_scan_levels_it(scan: Path, heading: str) -> None:
    """The refusal has the transforms for scan.json; with them the ground is level, and the splats
    are on the mesh."""
    turn = _turned(12.0)
    (scan / "mesh.glb").write_bytes(glb(turn(street())))
    cloud = splats_of(street())
    cloud.centres = turn(Street(cloud.centres, street().triangles, street().colours)).vertices
    (scan / "splats.ply").write_bytes(gaussian_ply(cloud))
    given = {"georeference": parse_georeference(f"55.698,13.195{heading}")}
    (words,) = _refused(_words(scan, **given))
    found = re.search(r'this in scan\.json, in place of scale and up: ("transform".*\]\])$', words)
    assert found is not None, words
    (scan / "scan.json").write_text("{" + found[1] + "}")
    repaired = _words(scan, splat_scale=None, splat_up=None, areas=None, **given)
    assert _refused(repaired) == []
    (level,) = (one for one in repaired if "degrees off the up axis" in one)
    assert float(level.split()[4]) < 0.3
    assert any(re.search(r"splats to mesh: 0\.0", one) for one in repaired)


def _refused(lines: list[str]) -> list[str]:
    return [words for words in lines if words.startswith("refused")]


def test_an_obj_with_a_texture_is_read(tmp_path: Path) -> None:
    """Vertices have the colour of a texture in another file, and a missing texture is reported."""
    from PIL import Image

    mesh = street().mesh()
    uv = np.column_stack([mesh.vertices[:, 0] / LENGTH_M, np.zeros(len(mesh.vertices))])
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=uv, image=Image.new("RGB", (8, 8), (200, 40, 10))
    )
    mesh.export(tmp_path / "mesh.obj")
    options = read_options(tmp_path, {"scale": 1.0, "up": "+z"})
    loaded, _ = scan_sources.load_mesh(tmp_path, options)
    assert (np.abs(loaded.mesh.colours.astype(int) - [200, 40, 10]) <= 1).all()
    for image in tmp_path.glob("*.png"):
        image.unlink()
    loaded, _ = scan_sources.load_mesh(tmp_path, options)
    assert any("its texture is missing" in str(one) for one in loaded.findings)
