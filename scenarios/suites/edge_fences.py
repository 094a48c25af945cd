"""Fences along both sides of a route, for maps with overlapping sidewalks.

Some imported maps draw footways next to or across pavements. Walkable ground then leads off the
route without a port, and fences at ports do not close it. A hem fences the ground of the route
wherever it borders on other walkable ground.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats
from cosim.place import overlay
from cosim.place.barriers import barrier_along, corner_of, ports_to_close
from cosim.place.street_map import SEAM_M, Port, StreetMap, Strip, union_closed
from cosim.spec.scenario import Barrier

_NEAR_M = 3.0
"""Largest distance at which other ground borders on the route, in metres."""
SMOOTH_M = 0.15
_SHORTEST_M = 0.02
_BESIDE_M = 0.5
STRIP_M = 5.0
"""Largest distance of a fence from the strip that it names: as the second fence, and as the
first.
"""
_FAR_M = 10_000.0
MOST = 150
"""Largest number of fences of a route."""


def edge_fences(street_map: StreetMap, way: Sequence[Port]) -> tuple[Barrier, ...]:
    """Return fences wherever the ground of a route borders on other walkable ground.

    Each fence names a port that it closes. These are the ports that lead off the route, and both
    ends of each strip that touches it. No pedestrian then walks through a fence.

    Raises SpecError if too many fences are needed.
    """
    strips = {port.strip for port in way}
    corners = sorted({corner_of(street_map, port) for port in way} - {""})
    pieces = [street_map.strips[name].polygon for name in sorted(strips)]
    ground = union_closed([*pieces, *(street_map.corners[name].polygon for name in corners)])
    walkable = street_map.walkable_near(shapely.buffer(ground, _NEAR_M))
    # Ground within SEAM_M of the edge of the walkable area has no neighbour.
    border = overlay.intersection(shapely.boundary(ground), shapely.buffer(walkable, -1.2 * SEAM_M))
    sides = np.array([side for line in shapely.get_parts(border) for side in _sides(line)]).reshape(
        -1, 2, 2
    )
    if len(sides) > MOST:
        raise SpecError(f"the way would need more than {MOST} fences: {len(sides)}")
    touching = [
        s for s in street_map.near("strip", ground) if isinstance(s, Strip) and s.id not in strips
    ]
    ends = [Port(s.id, end) for s in touching for end in (0, 1)]
    ports = list(dict.fromkeys([*ports_to_close(street_map, way), *ends]))
    if not len(sides) or not ports:
        return ()
    middles = sides.mean(axis=1)
    across = sides[:, 1] - sides[:, 0]
    return tuple(
        barrier_along(across[i], middles[i], ports[k]) for i, k in _named(street_map, sides, ports)
    )


def _named(street_map: StreetMap, sides: Floats, ports: Sequence[Port]) -> list[tuple[int, int]]:
    """Return pairs of a side and the port that its fence closes: the nearer end of the nearest
    strip.

    A port that is nearest to no side is named by a second fence on the same spot, near its strip.
    """
    lines = shapely.linestrings(sides)
    beside = np.array(
        [shapely.distance(street_map.strips[port.strip].polygon, lines) for port in ports]
    ).T
    ends = np.array(
        [street_map.strips[port.strip].line[0 if port.end == 0 else -1, :2] for port in ports]
    )
    apart = np.hypot(*(sides.mean(axis=1)[:, None] - ends[None]).transpose(2, 0, 1))
    # Of equally near strips, take the one with the nearer end.
    best = (np.round(beside, 1) * _FAR_M + apart).argmin(axis=1)
    if beside[np.arange(len(sides)), best].max() > STRIP_M:
        raise SpecError("the way borders on ground that belongs to no strip")
    named = [(i, int(k)) for i, k in enumerate(best)]
    for k in sorted(set(range(len(ports))) - set(best.tolist())):
        i = int(beside[:, k].argmin())
        if beside[i, k] <= _BESIDE_M:
            named.append((i, k))
    return named


def _sides(line: shapely.Geometry) -> Floats:
    """Return the ends of the straight pieces of a line, (N, 2, 2) m."""
    if shapely.get_dimensions(line) != 1:
        return np.empty((0, 2, 2))
    points = shapely.get_coordinates(shapely.simplify(line, SMOOTH_M))
    pairs = np.stack([points[:-1], points[1:]], axis=1)
    straight: Floats = pairs[np.hypot(*(pairs[:, 1] - pairs[:, 0]).T) >= _SHORTEST_M]
    return straight
