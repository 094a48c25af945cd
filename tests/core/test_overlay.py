"""Robust overlays of ground where GEOS fails: tangled corners and slivers, as imported maps have
them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon, box

from cosim.core.errors import MapError
from cosim.place import overlay
from sumo_nets.net.net_file import read_net
from sumo_nets.net.outlines import close_seams

Point = tuple[float, float]

TANGLED = (
    [
        (1747.70, 174.54),
        (1748.46, 173.49),
        (1747.08, 170.50),
        (1750.59, 172.01),
        (1747.34, 170.75),
        (1748.30, 171.06),
        (1745.09, 174.80),
        (1751.17, 172.61),
    ],
    [(1750.61, 172.33), (1750.53, 172.35), (1750.38, 172.62)],
    2.0,
)
"""A walking area that crosses itself, the middle line of a sidewalk that begins in it, and its
width; metres."""

CONFLICTING = (
    [
        (2025.37, 105.45),
        (2024.68, 104.96),
        (2025.67, 105.12),
        (2025.02, 105.54),
        (2024.97, 105.59),
        (2025.40, 105.45),
        (2025.02, 105.54),
    ],
    [(2025.37, 105.45), (2017.41, 104.93), (2017.11, 105.07)],
    3.2,
)
"""Another such case, for which GEOS reports a "side location conflict"."""


def test_a_net_with_a_corner_that_geos_cannot_join_is_read(tmp_path: Path) -> None:
    """The place is read although the wedge between a sidewalk and its tangled corner cannot be
    joined directly."""
    path = tmp_path / "tangled.net.xml"
    area, walk = (" ".join(f"{x},{y}" for x, y in shape) for shape in TANGLED[:2])
    path.write_text(
        f"""<net version="1.20"><edge id=":J_w0" function="walkingarea"><lane id=":J_w0_0" allow="pedestrian"
        length="3" shape="{area}"/></edge><edge id="a"><lane id="a_0" allow="pedestrian" width="{TANGLED[2]}" length="9"
        shape="{walk}"/></edge><connection from=":J_w0" to="a" fromLane="0" toLane="0"/></net>"""
    )
    strip = read_net(path).strips["a"]
    line = LineString(strip.line)
    assert strip.polygon.is_valid and strip.polygon.buffer(0.01).covers(line)
    assert strip.polygon.area >= 0.9 * line.length * TANGLED[2]


@pytest.mark.parametrize("shapes", [TANGLED, CONFLICTING], ids=["tangled", "conflicting"])
def test_the_seam_to_a_tangled_corner_is_closed(
    shapes: tuple[list[Point], list[Point], float],
) -> None:
    """The sidewalk grows to its corner of many touching pieces, and its own ground is unchanged."""
    area, walk, width_m = shapes
    parts = [
        p
        for p in shapely.get_parts(shapely.make_valid(Polygon(area)))
        if isinstance(p, Polygon) and p.area > 0.0
    ]
    band = shapely.buffer(LineString(walk), width_m / 2, cap_style="flat", join_style="mitre")
    (grown,) = close_seams(
        [band], [np.array(walk)], np.array([width_m]), [(MultiPolygon(parts), None)]
    )
    assert (
        grown.is_valid
        and grown.buffer(0.01).covers(band)
        and grown.area < band.area + 2.5 * width_m
    )


def crossing_itself() -> Polygon:
    """A bow tie, which GEOS does not overlay."""
    return Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])


@pytest.mark.parametrize("name", ["union", "difference", "intersection"])
def test_shapes_that_geos_refuses_are_repaired(name: str) -> None:
    """A self-crossing shape is overlaid alone and among others, whose bits do not change."""
    operation, plain = getattr(overlay, name), getattr(shapely, name)
    bow = crossing_itself()
    square = box(1.0, 1.0, 3.0, 9.0)
    with pytest.raises(shapely.errors.GEOSException, match=r"side location conflict|non-noded"):
        plain(bow, square)
    repaired = shapely.make_valid(bow, method="structure")
    assert operation(bow, square).is_valid
    assert operation(bow, square).area == pytest.approx(plain(repaired, square).area, abs=1e-6)
    sound = box(0.1, 0.2, 3.3, 7.7)
    many = operation(np.array([sound, bow, None], dtype=object), square)
    assert many[0].wkb == plain(sound, square).wkb and many[1].is_valid and many[2] is None


def test_shapes_that_geos_accepts_keep_their_bits() -> None:
    """Where the plain operation succeeds, nothing is repaired or snapped."""
    rng = np.random.default_rng(4)
    lines = shapely.linestrings(np.cumsum(rng.normal(0.0, 3.0, (60, 5, 2)), axis=1))
    shapes = shapely.buffer(lines, rng.uniform(0.5, 3.0, 60), cap_style="flat", join_style="mitre")
    assert overlay.union_all(shapes).wkb == shapely.union_all(shapes).wkb
    for name in ("union", "difference", "intersection"):
        mine, plain = (
            getattr(module, name)(shapes[:30], shapes[30:]) for module in (overlay, shapely)
        )
        assert [s.wkb for s in mine] == [s.wkb for s in plain]


def test_an_overlay_that_cannot_be_repaired_is_reported_with_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A persistent failure of GEOS is a MapError with the coordinates."""

    def broken(*_shapes: object, **_options: object) -> None:
        raise shapely.errors.GEOSException(
            "TopologyException: side location conflict at 12.345 -6.5."
        )

    monkeypatch.setattr(shapely, "union", broken)
    with pytest.raises(MapError, match=r"the ground near \(12\.3, -6\.5\) is too tangled"):
        overlay.union(box(0, 0, 1, 1), box(1, 0, 2, 1))
