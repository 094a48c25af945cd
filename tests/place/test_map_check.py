"""The check of a place, on an invented one that is small enough to count by hand."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.errors import MapError
from cosim.place.map_check import NetFacts, check_map
from cosim.place.street_map import Corner, Lane, Port, StreetMap, Strip
from cosim.place.terrain import Elevation
from sumo_nets.net.net_facts import crossing_signals, facts_of
from sumo_nets.net.net_file import read_net


def strip(name: str, *points: tuple[float, float], width_m: float = 2.0, **more: object) -> Strip:
    line = np.array(points)
    polygon = shapely.LineString(line).buffer(width_m / 2.0, cap_style="flat")
    kind = "crossing" if name.startswith(":") else "sidewalk"
    return dataclasses.replace(
        Strip(name, kind, line, width_m, polygon, (None, None)),  # type: ignore[arg-type]
        **more,  # type: ignore[arg-type]
    )


def road(
    name: str, *points: tuple[float, float], width_m: float = 6.0, internal: bool = False
) -> Lane:
    line = np.array(points)
    polygon = shapely.LineString(line).buffer(width_m / 2.0, cap_style="flat")
    return Lane(f"{name}_0", name, "road", line, width_m, polygon, internal)


def place(strips: list[Strip], corners: list[Corner], lanes: list[Lane]) -> StreetMap:
    every = np.vstack([s.line for s in strips])
    low, high = every.min(axis=0), every.max(axis=0)
    return StreetMap(
        "made-up",
        (float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        {s.id: s for s in strips},
        {c.id: c for c in corners},
        {lane.id: lane for lane in lanes},
        {},
    )


def town() -> StreetMap:
    """Two sidewalks of 200 m on both sides of a road, joined by a crossing in the east, with known
    faults."""
    strips = [
        strip("south", (0, 0), (200, 0), corners=(None, "cs")),
        strip("north", (0, 12), (200, 12), corners=(None, "cn")),
        strip(":x", (201, 1), (201, 11), corners=("cs", "cn"), width_m=3.2, signalised=True),
        strip("alley", (0, 60), (50, 60), width_m=0.8),
        strip("bridge", (100, -30), (100, 40)),
        strip("gutter", (20, 6), (60, 6)),
        strip("stub", (300, 0), (300.5, 0)),
    ]
    corners = [
        Corner("cs", shapely.box(200, -1, 202, 1), (Port("south", 1), Port(":x", 0))),
        Corner("cn", shapely.box(200, 11, 202, 13), (Port("north", 1), Port(":x", 1))),
    ]
    return place(
        strips,
        corners,
        [road("street", (0, 6), (200, 6)), road("inner", (200, 6), (208, 6), internal=True)],
    )


def test_figures_of_a_small_place() -> None:
    """Lengths, counts and shares equal those by hand."""
    check = check_map(town())
    assert (check.sidewalks, check.crossings, check.signalised, check.corners) == (6, 1, 1, 2)
    assert check.walkable_km == pytest.approx(0.5605)
    assert check.crossing_km == pytest.approx(0.010)
    assert check.roads_km == pytest.approx(0.2)
    assert [island.strips for island in check.islands] == [3, 1, 1, 1, 1]
    assert check.islands[0].share == pytest.approx(410 / 570.5)
    assert (check.narrow, check.narrow_km, check.narrowest_m) == (1, pytest.approx(0.05), 0.8)
    assert (check.stubs, check.dead_ends) == (1, 10)
    assert check.overlap_share == pytest.approx((80 + 12) / (400 + 400 + 40 + 140 + 80 + 1))
    assert (check.on_road, check.stacked) == (1, 1)
    found = {(problem.kind, problem.piece) for problem in check.problems}
    assert found == {
        *(("island", name) for name in ("alley", "bridge", "gutter", "stub")),
        ("narrow", "alley"),
        ("on_road", "gutter"),
        ("stacked", "bridge"),
    }


def test_corners_that_cars_drive_over_are_counted_and_listed() -> None:
    """Car paths inside a junction over a corner count; those over a crossing alone, or of bicycles,
    do not."""
    clear = town()
    turn = road("turn", (199, -0.5), (201, 1), (201, 11), internal=True)
    check = check_map(dataclasses.replace(clear, lanes={**clear.lanes, "turn_0": turn}))
    assert (
        check.driven_over == 1
        and "cars turn over 1 corners" in "".join(check.notes)
        and check_map(clear).driven_over == 0
    )
    (marked,) = [problem for problem in check.problems if problem.kind == "driven_over"]
    assert (marked.piece, round(marked.x_m), abs(round(marked.y_m))) == ("cs", 200, 0)
    bicycles = dataclasses.replace(turn, cars=False)
    over = road("over", (201, 2), (201, 10), internal=True)
    for lane in (bicycles, over):
        assert (
            check_map(dataclasses.replace(clear, lanes={**clear.lanes, "turn_0": lane})).driven_over
            == 0
        )


def test_a_place_in_pieces_gives_a_warning() -> None:
    """Where the largest island has less than 60 % of the length, the check explains the effect and
    the remedy."""
    connected = town()
    assert check_map(connected).warnings == ()
    far = strip("far", (0, 90), (400, 90))
    (warning,) = check_map(
        dataclasses.replace(connected, strips={**connected.strips, "far": far})
    ).warnings
    assert warning.startswith(
        "the largest of 6 islands of connected walkways has 42% of their length: scenarios are"
    )
    assert "Import another part (--bbox)" in warning


def test_places_without_walks_or_corners_are_not_usable() -> None:
    """The reason names which of them is missing."""
    lonely = place([strip("a", (0, 0), (100, 0))], [], [])
    assert check_map(lonely).reasons[0].startswith("its sidewalks are not connected")
    bare = dataclasses.replace(lonely, strips={})
    check = check_map(bare)
    assert (
        check.reasons == ("nothing is walkable: no sidewalk, path or crossing",)
        and check.islands == ()
    )


def net() -> ET.Element:
    """A net with everything that NetFacts counts."""
    return ET.fromstring(
        """<net version="1.9" lefthand="true"><location projParameter="+proj=utm +zone=33"/>
        <edge id=":J_w0" function="walkingarea"><lane shape="0,0 4,4 4,0 0,4"/></edge>
        <edge id=":J_c0" function="crossing"><lane length="6"/></edge>
        <edge id=":J_c1" function="crossing"><lane length="6"/></edge>
        <edge id=":J_c2" function="crossing"><lane length="6"/></edge>
        <edge id=":J_c3" function="crossing"><lane length="6"/></edge>
        <edge id="a"><lane allow="pedestrian" length="500" shape="0,0,1 10,0,2 20,0 21,0,90"/>
          <lane disallow="pedestrian" length="500" shape="0,0 500,0"/></edge>
        <edge id="b"><lane allow="bicycle pedestrian" length="300" width="2" shape="0,0,0 10,0,9"/>
          <param key="bridge" value="yes"/></edge>
        <edge id="c"><lane length="200" shape="0,0 200,0"/></edge>
        <edge id="d"><lane allow="pedestrian" length="10" width="2" shape="0,0 10,0"/>
          <param key="tunnel" value="building_passage"/></edge>
        <tlLogic id="T" type="static" programID="0"><phase duration="9" state="GGG"/></tlLogic>
        <tlLogic id="T" type="static" programID="1"><phase duration="9" state="rG"/>
          <phase duration="9" state="rg"/></tlLogic>
        <connection from=":J_w0" to=":J_c0" tl="T" linkIndex="0"/>
        <connection from=":J_w0" to=":J_c1" tl="T" linkIndex="1"/>
        <connection from=":J_w0" to=":J_c2" tl="T" linkIndex="7"/>
        <connection from=":J_w0" to=":J_c3" tl="rails" linkIndex="0"/></net>"""
    )


def test_facts_of_a_net() -> None:
    """Kinds of walkways, elevations, levels and signals are counted separately, and the last
    program of a signal counts."""
    facts: NetFacts = facts_of(net())
    assert (facts.version, facts.left_hand, facts.projected, facts.edges) == ("1.9", True, True, 4)
    assert (facts.pavement_km, facts.shared_km, facts.mixed_km) == (pytest.approx(0.51), 0.3, 0.2)
    assert facts.walkable_km == pytest.approx(1.01)
    assert (facts.areas, facts.twisted_areas, facts.crossings, facts.widths_missing) == (1, 1, 4, 1)
    assert (facts.elevation_m, facts.steep, facts.false_grades) == ((0.0, 90.0), 2, 1)
    assert facts.levels == ("b",) and facts.levels_km == pytest.approx(0.3)
    assert (facts.never_green, facts.always_green) == ((":J_c0",), (":J_c1",))
    assert (facts.misfits, facts.no_program, facts.signals) == ((":J_c2",), ("rails",), 1)
    assert crossing_signals(net()).never == [":J_c0"]


def test_notes_list_what_is_not_used() -> None:
    """Dropped or changed elevations, bridges, level crossings and dead signals are named."""
    land = Elevation(
        low_m=0.0, high_m=90.0, points=50, missing=7, false_share=0.1, clamped=3, moved_m=1.25
    )
    false = dataclasses.replace(
        town(), elevation=dataclasses.replace(land, dropped="it is the same everywhere")
    )
    assert (
        "elevation 0 to 90 m is dropped, the ground is flat: it is the same"
        in check_map(false).notes[-1]
    )
    elevated = dataclasses.replace(
        town(), elevation=dataclasses.replace(land, steep=(next(iter(town().strips)),))
    )
    notes = "\n".join(check_map(elevated, None, facts_of(net())).notes)
    assert [p.piece for p in check_map(elevated).problems if p.kind == "steep"] == list(
        elevated.steep
    )
    for words in (
        "elevation 0 to 90 m is kept; 7 of 50 points had none or a false one",
        "3 places on streets were moved, by up to 1.2 m",
        "km) are steeper than 20% somewhere",
        "0.20 km that people share with cars",
        "1 walkable edges (0.30 km) are on bridges",
        "1 walkable lanes name no width",
        "level crossings are run by SUMO itself: rails",
        "never green: :J_c0",
        "always green: :J_c1",
        "beyond their signal's program: :J_c2",
    ):
        assert words in notes


def test_widths_of_imported_nets(tmp_path: Path) -> None:
    """A width of -1 means SUMO's default, and one that is no number is refused."""
    path = tmp_path / "w.net.xml"
    text = """<net version="1.9"><location convBoundary="0,0,9,9"/><edge id="a"><lane id="a_0" allow="pedestrian"
        width="-1.00" length="9" shape="0,0 9,0"/></edge></net>"""
    path.write_text(text)
    assert read_net(path).strips["a"].width_m == 3.2
    for wrong in ("nan", "inf"):
        path.write_text(text.replace("-1.00", wrong))
        with pytest.raises(MapError, match=r"lane 'a_0': width '(nan|inf)' is"):
            read_net(path)
