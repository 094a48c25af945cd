"""Cities from a seed: the plan, the built net, its signals, and the store of nets."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from collections import Counter, defaultdict
from pathlib import Path

import pytest
import shapely

from cosim.core.cache import BUILDING_PREFIX, clean_up
from cosim.core.errors import MapError, UsageError
from cosim.place.street_map import StreetMap
from cosim.spec.scenario import City
from sumo_nets.city.blocks import CLASSES, bend, corner, direction, length, ring, split
from sumo_nets.city.city import STYLES, plan_city
from sumo_nets.city.plan import CityPlan
from sumo_nets.city.signals import signal_faults
from sumo_nets.city.store import city_net
from sumo_nets.crowd.group_sampling import GROUP_STRIPE_M
from sumo_nets.net.net_file import read_net
from sumo_nets.net.netconvert import netconvert
from sumo_nets.net.raw_file import net_content_hash
from tests.conftest import PATIENCE_S, wait_until

SAMPLE = [
    (1, 200.0, "mixed"),
    (2, 450.0, "suburb"),
    (3, 700.0, "downtown"),
]


@pytest.fixture(scope="module")
def built() -> dict[tuple[int, float, str], Path]:
    """Build the nets of SAMPLE."""
    return {one: city_net(City(seed=one[0], size_m=one[1], style=one[2])) for one in SAMPLE}


@pytest.fixture(scope="module")
def street_maps(
    built: dict[tuple[int, float, str], Path],
) -> dict[tuple[int, float, str], StreetMap]:
    """Read the maps of the built nets."""
    return {one: read_net(path) for one, path in built.items()}


def groups(place: StreetMap) -> list[set[str]]:
    """Return the strips of a map by connected component of the walking graph."""
    beside: dict[str, set[str]] = defaultdict(set)
    for area in place.corners.values():
        for port in area.ports:
            beside[port.strip] |= {other.strip for other in area.ports}
    left = set(place.strips)
    found = []
    while left:
        front = [left.pop()]
        group = set(front)
        while front:
            fresh = beside[front.pop()] - group
            group |= fresh
            front += fresh
        left -= group
        found.append(group)
    return found


def arms(plan: CityPlan) -> dict[str, list[float]]:
    """Return headings with which two-way streets leave each node."""
    found = defaultdict(list)
    for edge in plan.edges:
        if edge.street_class != "ring":
            found[edge.tail].append(direction(edge.line[0], edge.line[1]))
    return found


def test_primitive_lines_keep_their_ends_and_turns() -> None:
    """Curves leave and arrive with the requested turn."""
    a, b = (0.0, 0.0), (100.0, 0.0)
    curve = bend(a, b, 0.5, -0.5)
    s_bend = bend(a, b, 0.5, 0.5)
    for line in (curve, s_bend, corner(a, (100.0, 80.0), b, 30.0)):
        assert (line[0], line[-1]) == (a, b)
        assert length(line) > 100.0
    assert max(y for _, y in curve) > 10.0 > -0.1 < min(y for _, y in curve)
    assert min(y for _, y in s_bend) < -2.0 and max(y for _, y in s_bend) > 2.0
    first, second = split(curve, 40.0)
    assert first[-1] == second[0] and length(first) == pytest.approx(40.0, abs=0.1)
    arcs = ring(a, 20.0, [0.1, 2.0, 4.0])
    assert sum(length(arc) for arc in arcs) == pytest.approx(2.0 * math.pi * 20.0, rel=0.01)


def test_same_seed_gives_the_same_plan_and_another_seed_another() -> None:
    """A plan is a function of seed, size and style alone."""
    one, same, other = (plan_city(seed, 1000.0, "mixed") for seed in (7, 7, 8))
    assert (one.nodes, one.edges, one.zebras, one.rings) == (
        same.nodes,
        same.edges,
        same.zebras,
        same.rings,
    )
    assert one.edges != other.edges
    assert one.edges != plan_city(7, 1000.0, "suburb").edges


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("style", sorted(STYLES))
def test_streets_meet_at_wide_angles_and_stay_inside(seed: int, style: str) -> None:
    """Arms are more than 45 degrees apart, streets longer than 30 m, no node is a dead end, and all
    are inside the square."""
    plan = plan_city(seed, 1200.0, style)
    for node, headings in arms(plan).items():
        order = sorted(h % (2.0 * math.pi) for h in headings)
        gaps = [b - a for a, b in zip(order, [*order[1:], order[0] + 2.0 * math.pi], strict=True)]
        assert len(order) > 1 or any(node in r.nodes for r in plan.rings)
        assert len(order) == 1 or min(gaps) > math.radians(45.0)
    for edge in plan.edges:
        assert edge.street_class == "ring" or length(edge.line) > 40.0
        reach = edge.section.half_m
        assert all(reach < x < 1200.0 - reach and reach < y < 1200.0 - reach for x, y in edge.line)


def test_a_large_city_has_every_primitive_block() -> None:
    """A 2 km city has straights, curves, corners, T, X and Y junctions, roundabouts and mid-block
    crosswalks."""
    plan = plan_city(1, 2000.0, "mixed")
    degrees = Counter(len(headings) for headings in arms(plan).values())
    assert degrees[2] > 50 and degrees[3] > 50 and degrees[4] > 50
    assert len(plan.rings) >= 2
    bent = sum(len(edge.line) > 2 for edge in plan.edges) / len(plan.edges)
    assert 0.3 < bent < 0.8
    assert {edge.street_class for edge in plan.edges} >= {"residential", "commercial", "ring"}


def test_sidewalks_fit_the_stripes_of_the_crowd_model() -> None:
    """Every sidewalk and every crossing is an odd number of 0.64 m stripes wide."""
    for made in CLASSES.values():
        assert all(
            round(width / GROUP_STRIPE_M, 6) % 2 == 1
            for width in (*made.sidewalks_m, *made.crossings_m)
        )


def test_widths_differ_within_the_ranges_of_the_class() -> None:
    """One street has one cross-section; streets of a class differ within its ranges, and wide ones
    have islands."""
    plan = plan_city(3, 2000.0, "mixed")
    sections = defaultdict(set)
    for edge in plan.edges:
        sections[edge.street_class].add(edge.section)
    for name, found in sections.items():
        made = CLASSES[name]
        for section in found:
            assert section.sidewalk_m in made.sidewalks_m and section.lanes == made.lanes
            for width in ("lane_m", "verge_m", "frontage_m", "curb_m", "gutter_m", "median_m"):
                low, high = getattr(made, width)
                assert low - 0.026 <= getattr(section, width) <= high + 0.026
            assert (section.median_m > 0.5) == (made.lanes > 1)
    assert len(sections["residential"]) > 4


def test_driveways_keep_off_the_ends_of_their_street() -> None:
    """Driveways exist on both sides, far from junctions and crosswalks."""
    edges = [edge for edge in plan_city(3, 2000.0, "mixed").edges if edge.driveways]
    assert len(edges) > 40 and {edge.id[0] for edge in edges} == {"-", "s"}
    for edge in edges:
        assert all(
            math.dist(at, end) > 25.0
            for at in edge.driveways
            for end in (edge.line[0], edge.line[-1])
        )


def test_cities_out_of_range_are_refused() -> None:
    """Size, style and seed are checked, and the message lists the valid values."""
    with pytest.raises(MapError, match=r"size_m must be in \[200, 4000\], not 50"):
        plan_city(1, 50.0, "mixed")
    with pytest.raises(
        UsageError, match=r"unknown city style 'x'. Valid choices: downtown, mixed, suburb."
    ):
        plan_city(1, 500.0, "x")
    with pytest.raises(MapError, match="cannot be negative: -1"):
        plan_city(-1, 500.0, "mixed")


@pytest.mark.engine
def test_a_built_city_is_one_walkable_piece(
    street_maps: dict[tuple[int, float, str], StreetMap],
) -> None:
    """Every strip has a corner at both ends and is reachable from every other one, and 99 % of the
    area is one piece."""
    for place in street_maps.values():
        assert all(None not in strip.corners for strip in place.strips.values())
        assert len(groups(place)) == 1
        areas = [part.area for part in shapely.get_parts(place.walkable)]
        assert max(areas) > 0.99 * sum(areas)


@pytest.mark.engine
def test_built_city_keeps_the_zones_of_its_plan(
    street_maps: dict[tuple[int, float, str], StreetMap],
) -> None:
    """Sidewalks have the widths of their street class, the road on their left, and verges
    between."""
    sections = {edge.id: edge for edge in plan_city(*SAMPLE[2]).edges}
    place = street_maps[SAMPLE[2]]
    lanes: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for lane in place.lanes.values():
        if not lane.internal:
            lanes[lane.edge].append((lane.kind, lane.width_m))
    for strip in place.strips.values():
        if strip.kind == "sidewalk":
            section = sections[strip.id].section
            assert (strip.width_m, strip.frontage_m, strip.verge_m) == (
                section.sidewalk_m,
                section.frontage_m,
                section.verge_m,
            )
            assert strip.curb_m == pytest.approx(section.curb_m + section.gutter_m)
            assert (strip.road_side, strip.street_class) == (1, sections[strip.id].street_class)
            median = [("verge", section.median_m)] if section.median_m else []
            road = [("road", section.lane_m)] * section.lanes
            assert lanes[strip.id] == [("verge", section.verge_m), *road, *median]
            assert len(strip.driveways) == len(sections[strip.id].driveways)
            assert all(6.0 < at < strip.length_m - 6.0 for at in strip.driveways)


@pytest.mark.engine
def test_every_signalised_crossing_has_time_to_cross(
    built: dict[tuple[int, float, str], Path], street_maps: dict[tuple[int, float, str], StreetMap]
) -> None:
    """Crossings get 8 s of green and are cleared at 1.1 m/s before cars go, and no two links
    conflict."""
    for path in built.values():
        assert signal_faults(path.read_bytes()) == []
    assert sum(strip.signalised for strip in street_maps[SAMPLE[2]].strips.values()) > 20


@pytest.mark.engine
def test_faulty_signal_programs_are_found(
    built: dict[tuple[int, float, str], Path],
) -> None:
    """The check of signals finds a crossing that never gets green, and one that is not cleared."""
    net = built[SAMPLE[2]].read_bytes()
    assert any("never changes" in fault for fault in signal_faults(net.replace(b'G"/>', b'r"/>')))
    hasty = net.replace(b'duration="2"', b'duration="0"').replace(b'duration="3"', b'duration="1"')
    assert any("is cleared for" in fault for fault in signal_faults(hasty))


@pytest.mark.engine
def test_sumo_loads_a_city_without_warnings(built: dict[tuple[int, float, str], Path]) -> None:
    """SUMO finds no fault in topology and programs."""
    import sumo

    binary = Path(sumo.__file__).parent / "bin" / "sumo"
    for path in built.values():
        command = [str(binary), "-n", str(path), "-e", "1", "--no-step-log"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.engine
def test_city_is_equal_to_the_byte_in_another_process(
    built: dict[tuple[int, float, str], Path], tmp_path: Path
) -> None:
    """Building the same city in another process, with another hash seed, gives the same file."""
    seed, size_m, style = SAMPLE[2]
    code = (
        "from sumo_nets.city.store import city_net; from cosim.spec.scenario import City;"
        f"print(city_net(City(seed={seed}, size_m={size_m}, style={style!r})))"
    )
    environment = os.environ | {"COSIM_CACHE": str(tmp_path), "PYTHONHASHSEED": "123"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    digests = [
        hashlib.sha256(p.read_bytes()).hexdigest()
        for p in (Path(done.stdout.strip()), built[SAMPLE[2]])
    ]
    assert digests[0] == digests[1]


@pytest.mark.engine
def test_store_builds_once_and_refuses_another_net(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second request is served from the cache, and nets that were not used for long are
    deleted. A scenario made on another net is refused with a remedy."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    (tmp_path / "old.net.xml").write_text("<net/>")
    os.utime(tmp_path / "old.net.xml", (0.0, 0.0))
    path = city_net(City(seed=9, size_m=200.0))
    built = path.stat().st_ino
    os.utime(path, (0.0, 0.0))
    assert city_net(City(seed=9, size_m=200.0, net_hash=net_content_hash(path))) == path
    assert path.stat().st_ino == built and path.stat().st_mtime > 0.0
    assert [p.name for p in tmp_path.iterdir() if not p.name.startswith(".")] == [path.name]
    clean_up(limit_bytes=0)
    assert path.exists()
    with pytest.raises(
        MapError, match=r"made on 0123456789abcdef: delete the file to build it again"
    ):
        city_net(City(seed=9, size_m=200.0, net_hash="0123456789abcdef"))


@pytest.mark.engine
def test_concurrent_processes_build_one_city(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each gets the complete net, also when one of them is killed while it builds, and its scratch
    files are removed."""
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    code = (
        "from sumo_nets.city.store import city_net, is_undamaged; from cosim.spec.scenario import City;"
        "print(is_undamaged(city_net(City(seed=9, size_m=200.0))))"
    )

    def building() -> subprocess.Popen[str]:
        return subprocess.Popen([sys.executable, "-c", code], stdout=-1, text=True)

    dies = building()
    begun = f"{BUILDING_PREFIX}*/*.xml"
    wait_until(lambda: dies.poll() is not None or list(tmp_path.glob(begun)))
    assert dies.poll() is None
    others = [building() for _ in range(2)]
    dies.kill()
    dies.communicate()
    assert [other.communicate(timeout=PATIENCE_S)[0] for other in others] == ["True\n"] * 2
    clean_up()
    assert [path.name for path in tmp_path.iterdir() if path.name not in (".lock", ".in-use")] == [
        city_net(City(seed=9, size_m=200.0)).name
    ]


@pytest.mark.engine
def test_netconvert_failures_give_one_line(tmp_path: Path) -> None:
    """Invalid input ends in a MapError of one line with netconvert's own message."""
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net")
    with pytest.raises(
        MapError, match=r"^netconvert failed with exit code 1: .*broken\.net\.xml[^\n]*$"
    ):
        netconvert(["-s", str(broken)], tmp_path / "out.net.xml")
