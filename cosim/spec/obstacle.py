"""Obstacles on the walkable ground of a scenario, and their footprints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Final, Literal

import shapely
from shapely.geometry import Polygon

from cosim.spec.validation import COORDINATE_M, HEADING_RAD, Ranged, Within, shown

ObstacleKind = Literal["bin", "bike", "sign", "planter", "box", "fence", "scooter", "cafe"]
"""Kinds of obstacles. "sign" is a sandwich board, "box" a stack of parcels, "fence" a construction
fence, "cafe" a table with chairs."""

_Size = tuple[float, float, float]
"""Length along the heading, depth across it, and height, in metres."""

OBSTACLE_SIZES_M: Final[Mapping[ObstacleKind, tuple[_Size, _Size]]] = {
    "bin": ((0.48, 0.55, 0.95), (0.60, 0.74, 1.10)),
    "bike": ((1.65, 0.55, 1.00), (1.80, 0.62, 1.10)),
    "sign": ((0.45, 0.58, 0.95), (0.60, 0.70, 1.20)),
    "planter": ((0.60, 0.45, 0.90), (1.20, 0.60, 1.15)),
    "box": ((0.50, 0.40, 0.45), (1.00, 0.60, 0.85)),
    "fence": ((1.00, 0.46, 1.05), (2.20, 0.46, 1.15)),
    "scooter": ((1.10, 0.45, 1.15), (1.20, 0.50, 1.20)),
    "cafe": ((1.75, 0.60, 0.85), (1.95, 0.75, 0.85)),
}
"""Smallest and largest size of each kind."""

OBSTACLE_VARIANTS: Final = 3
"""Number of sizes of each kind, evenly from the smallest to the largest."""
OBSTACLE_FORMS: Final = 4 * OBSTACLE_VARIANTS
"""Number of combinations of size and paint."""


class Obstacle(Ranged, frozen=True, kw_only=True):
    """Obstacle on the way.

    heading_rad: direction of its length.
    form: number of its size and paint, below `OBSTACLE_FORMS`.

    >>> Obstacle(kind="bin", x_m=3.0, y_m=4.0, heading_rad=0.0, form=2).size_m
    (0.6, 0.74, 1.1)
    """

    kind: ObstacleKind
    x_m: Annotated[float, COORDINATE_M]
    y_m: Annotated[float, COORDINATE_M]
    heading_rad: Annotated[float, HEADING_RAD]
    form: Annotated[int, Within(0, OBSTACLE_FORMS - 1)] = 0

    @property
    def prefix(self) -> str:
        return f"obstacle {shown(self.kind)} at ({self.x_m:.2f}, {self.y_m:.2f}): "

    @property
    def variant(self) -> int:
        """Number of its size, from the smallest."""
        return self.form % OBSTACLE_VARIANTS

    @property
    def paint(self) -> int:
        return self.form // OBSTACLE_VARIANTS

    @property
    def size_m(self) -> _Size:
        return obstacle_size_m(self.kind, self.variant)


def obstacle_size_m(kind: ObstacleKind, variant: int) -> _Size:
    """Return the size of a variant of a kind."""
    low, high = OBSTACLE_SIZES_M[kind]
    share = variant / (OBSTACLE_VARIANTS - 1)
    length, depth, height = (round(a + (b - a) * share, 6) for a, b in zip(low, high, strict=True))
    return length, depth, height


def footprint(obstacle: Obstacle, margin_m: float = 0.0) -> Polygon:
    """Return the rectangle of ground that an obstacle covers, grown by a margin."""
    length, depth, _ = obstacle.size_m
    cos, sin = math.cos(obstacle.heading_rad), math.sin(obstacle.heading_rad)
    ahead, aside = 0.5 * length + margin_m, 0.5 * depth + margin_m
    corners = [(-ahead, -aside), (ahead, -aside), (ahead, aside), (-ahead, aside)]
    return shapely.Polygon(
        [(obstacle.x_m + cos * u - sin * v, obstacle.y_m + sin * u + cos * v) for u, v in corners]
    )
