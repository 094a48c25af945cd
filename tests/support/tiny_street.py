"""One street with a crossing, small enough to check by hand, and measures of the triangles of its
ground."""

from __future__ import annotations

import numpy as np
import shapely

from cosim.place.street_map import Corner, Lane, Port, StreetMap, Strip
from physics.ground.tiles import Key, Tile, tile_bounds, tiles_within

KEYS = tiles_within(0.0, 0.0, 60.0)


def tiny_map() -> StreetMap:
    """Return a street along x with sidewalks on both sides, one crossing at x = 0, and a verge on
    the south side."""

    def strip(
        name: str, x0: float, x1: float, y0: float, y1: float, corner: str, end: int, side: int
    ) -> Strip:
        line = np.array([[x0, (y0 + y1) / 2], [x1, (y0 + y1) / 2]])
        corners = (None, corner) if end else (corner, None)
        polygon = shapely.box(x0, y0, x1, y1)
        return Strip(
            name, "sidewalk", line, y1 - y0, polygon, corners, frontage_m=2.0, road_side=side
        )

    strips = [
        strip("nw", -80, -2, 3.5, 6.5, "n", 1, -1),
        strip("ne", 2, 80, 3.5, 6.5, "n", 0, -1),
        strip("sw", -80, -2, -8, -5, "s", 1, 1),
        strip("se", 2, 80, -8, -5, "s", 0, 1),
        Strip(
            ":c0",
            "crossing",
            np.array([[0, -3.5], [0, 3.5]]),
            3.2,
            shapely.box(-1.6, -3.5, 1.6, 3.5),
            ("s", "n"),
        ),
    ]
    corners = [
        Corner("n", shapely.box(-2, 3.5, 2, 6.5), (Port("nw", 1), Port("ne", 0), Port(":c0", 1))),
        Corner("s", shapely.box(-2, -8, 2, -3.5), (Port("sw", 1), Port("se", 0), Port(":c0", 0))),
    ]
    lanes = [
        Lane(
            "e_1",
            "e",
            "road",
            np.array([[-80, -1.75], [80, -1.75]]),
            3.5,
            shapely.box(-80, -3.5, 80, 0),
        ),
        Lane(
            "-e_1",
            "-e",
            "road",
            np.array([[80, 1.75], [-80, 1.75]]),
            3.5,
            shapely.box(-80, 0, 80, 3.5),
        ),
        Lane(
            "e_0",
            "e",
            "verge",
            np.array([[-80, -4.25], [-2, -4.25]]),
            1.5,
            shapely.box(-80, -5, -2, -3.5),
        ),
        Lane(
            "f_0",
            "f",
            "verge",
            np.array([[2, -4.25], [80, -4.25]]),
            1.5,
            shapely.box(2, -5, 80, -3.5),
        ),
    ]
    return StreetMap(
        "tiny",
        (-80, -40, 80, 40),
        {s.id: s for s in strips},
        {c.id: c for c in corners},
        {lane.id: lane for lane in lanes},
        {},
    )


def triangles(tile: Tile, name: str) -> np.ndarray:
    """Return (T, 3, 3) corners of one kind of ground."""
    mesh = tile.parts[name]
    return mesh.vertices[mesh.triangles]


def plan_areas(corners: np.ndarray) -> np.ndarray:
    """Return (T,) signed areas seen from above."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])


def assert_no_cracks(key: Key, corners: np.ndarray) -> None:
    """Assert that every edge off the border of a tile of (N, 3, 3) triangles is shared by two of
    them."""
    edges: dict[frozenset[tuple[int, ...]], int] = {}
    for triangle in np.rint(corners * 1e3).astype(int).tolist():
        for a, b in zip(triangle, triangle[1:] + triangle[:1], strict=True):
            edge = frozenset((tuple(a), tuple(b)))
            edges[edge] = edges.get(edge, 0) + 1
    x0, y0, x1, y1 = (round(1e3 * c) for c in tile_bounds(key))
    for edge, count in edges.items():
        xs, ys = {p[0] for p in edge}, {p[1] for p in edge}
        on_border = (
            xs in ({x0}, {x1}) or ys in ({y0}, {y1}) or len(edge) == 1 or (len(xs) == len(ys) == 1)
        )
        assert count == 2 or on_border, (key, edge, count)
