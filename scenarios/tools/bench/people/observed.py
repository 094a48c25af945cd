"""What was measured of people, as far as it is published in few figures: means, deviations,
percentiles."""

from __future__ import annotations

from typing import Final, NamedTuple


class MeanSd(NamedTuple):
    """A mean and a standard deviation."""

    mean: float
    sd: float


DENSITY_EDGES: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Persons per square metre in a window 2 m long, between which speeds are put together."""

SPEED_BY_DENSITY_MPS: Final = (
    MeanSd(1.45, 0.29),
    MeanSd(1.40, 0.22),
    MeanSd(1.17, 0.24),
    MeanSd(0.92, 0.23),
    MeanSd(0.62, 0.17),
    MeanSd(0.47, 0.10),
)
"""The corridor of the HERMES project, for each interval of DENSITY_EDGES."""

FREE_SPEED_MPS: Final = {
    "ETH": MeanSd(1.47, 0.35),
    "Hotel": MeanSd(1.40, 0.40),
    "zara01": MeanSd(1.16, 0.30),
    "zara02": MeanSd(1.21, 0.31),
    "students03": MeanSd(0.84, 0.35),
}
"""Of the walkers in the films of ETH (Pellegrini et al. 2009) and UCY (Lerner et al. 2007)."""

NEAREST_PERCENT: Final = (1.0, 5.0, 50.0)
NEAREST_M: Final = {
    "ETH": (0.48, 0.60, 1.08),
    "Hotel": (0.39, 0.50, 1.19),
    "zara01": (0.49, 0.61, 0.97),
    "zara02": (0.37, 0.46, 0.80),
    "students03": (0.35, 0.44, 0.69),
}
"""Percentiles NEAREST_PERCENT of how far the middles of somebody and the nearest other are apart,
same films."""

PERSON_FIRST_PERCENT: Final = (5.0, 10.0, 25.0, 50.0)
PERSON_FIRST_S: Final = (3.2, 3.7, 4.7, 6.8)
VEHICLE_FIRST_PERCENT: Final = (5.0, 25.0, 50.0)
VEHICLE_FIRST_S: Final = (2.4, 3.2, 4.3)
"""Post-encroachment times of the DUT films (Yang et al. 2019), where people and cars meet without
signals."""
