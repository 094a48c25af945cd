"""Measured walking of people, with which `cosim bench people` compares the simulated crowd."""

from __future__ import annotations

from typing import Final, NamedTuple

DENSITY_EDGES: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Persons per square metre in a window 2 m long: edges of the intervals that group speeds."""
NEAREST_PERCENT: Final = (1.0, 5.0, 50.0)
NEAREST_M: Final = {
    "ETH": (0.48, 0.60, 1.08),
    "Hotel": (0.39, 0.50, 1.19),
    "zara01": (0.49, 0.61, 0.97),
    "zara02": (0.37, 0.46, 0.80),
    "students03": (0.35, 0.44, 0.69),
}
"""Distance of a person to the nearest other, metres, at NEAREST_PERCENT.

Films: ETH (Pellegrini et al. 2009) and UCY (Lerner et al. 2007).
"""
PERSON_FIRST_PERCENT: Final = (5.0, 10.0, 25.0, 50.0)
PERSON_FIRST_S: Final = (3.2, 3.7, 4.7, 6.8)
VEHICLE_FIRST_PERCENT: Final = (5.0, 25.0, 50.0)
VEHICLE_FIRST_S: Final = (2.4, 3.2, 4.3)
"""Post-encroachment times, seconds, at VEHICLE_FIRST_PERCENT; PERSON_FIRST_S: of people that
cross first.

Films: DUT (Yang et al. 2019), where people and cars meet without signals.
"""


class MeanSd(NamedTuple):
    """A mean and a standard deviation."""

    mean: float
    sd: float


SPEED_BY_DENSITY_MPS: Final = (
    MeanSd(1.45, 0.29),
    MeanSd(1.40, 0.22),
    MeanSd(1.17, 0.24),
    MeanSd(0.92, 0.23),
    MeanSd(0.62, 0.17),
    MeanSd(0.47, 0.10),
)
"""Speed in the corridor of the HERMES project, for each interval of DENSITY_EDGES."""

FREE_SPEED_MPS: Final = {
    "ETH": MeanSd(1.47, 0.35),
    "Hotel": MeanSd(1.40, 0.40),
    "zara01": MeanSd(1.16, 0.30),
    "zara02": MeanSd(1.21, 0.31),
    "students03": MeanSd(0.84, 0.35),
}
"""Speed of people walking alone, in the same films as NEAREST_M."""
