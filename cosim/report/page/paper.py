"""Results of the paper's models, in its own engine with its own pictures, copied as published.

Source: "SidewalkBench", its tables `tab:terrain_only` (unit tests), `tab:hand_crafted` and
    `tab:hand_crafted_full` (pedestrian-reactive), `tab:long_horizon`. None: the paper has a dash,
    or no row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

Row = tuple[float | None, ...]

_NO: Final = None

EVENT_COLUMNS: Final = (
    "static",
    "obstructing",
    "conversing",
    "queueing",
    "frontal",
    "lateral",
    "overtaking",
    "ped_crossing",
    "gesturing",
)
"""Columns of the paper's pedestrian-reactive tables, in its order."""

_UNIT_GENERATED: Final[Mapping[str, Row]] = {
    "ViNT": (0.00, 0.00, 0.21, 0.00, 0.00, 0.21, 0.00, 0.00, 0.44),
    "NoMaD": (0.00, 0.00, 0.36, 0.02, 0.02, 0.51, 0.00, 0.00, 0.87),
    "MBRA": (0.41, 0.40, 0.68, 0.00, 0.00, 0.44, 0.68, 0.67, 0.99),
    "InternVLA-N1": (0.30, 0.29, 0.55, 0.01, 0.01, 0.44, 0.01, 0.01, 0.72),
    "CityWalker": (0.48, 0.47, 0.70, 0.02, 0.02, 0.49, 0.99, 0.95, 0.99),
    "MIMIC": (0.39, 0.39, 0.59, 0.23, 0.23, 0.54, 0.56, 0.55, 0.69),
    "S2E": (0.69, 0.68, 0.83, 0.28, 0.28, 0.63, 0.75, 0.74, 0.99),
    "FlowPilot": (0.70, 0.69, 0.83, 0.47, 0.47, 0.70, 0.68, 0.66, 0.98),
    "OpenPilot": (0.78, 0.77, 0.87, 0.57, 0.57, 0.80, 0.98, 0.97, 1.00),
}
"""SR, SPL, RC of straight, curve, crosswalk in generated places."""
_UNIT_SCANNED: Final[Mapping[str, Row]] = {
    "ViNT": (0.00, 0.00, 0.33, 0.00, 0.00, 0.26, 0.00, 0.00, 0.32),
    "NoMaD": (0.00, 0.00, 0.42, 0.30, 0.30, 0.66, 0.00, 0.00, 0.57),
    "MBRA": (0.40, 0.40, 0.67, 0.00, 0.00, 0.53, 0.60, 0.60, 0.87),
    "InternVLA-N1": (0.00, 0.00, 0.47, 0.00, 0.00, 0.34, 0.00, 0.00, 0.39),
    "CityWalker": (0.80, 0.79, 0.84, 0.10, 0.10, 0.70, 1.00, 0.98, 1.00),
    "MIMIC": (0.30, 0.30, 0.39, 0.00, 0.00, 0.30, 0.40, 0.40, 0.94),
    "S2E": (0.90, 0.90, 0.91, 0.50, 0.50, 0.76, 0.30, 0.30, 0.80),
    "FlowPilot": (0.80, 0.79, 0.88, 0.20, 0.20, 0.70, 1.00, 1.00, 1.00),
    "OpenPilot": (0.90, 0.89, 0.96, 0.60, 0.59, 0.86, 0.90, 0.88, 0.91),
}
"""SR, SPL, RC of straight, curve, crosswalk in scanned places."""
UNIT_OF_PAPER: Final[Mapping[str, Row]] = {
    model: row + _UNIT_SCANNED[model] for model, row in _UNIT_GENERATED.items()
}
"""Both of these: generated places, then scanned ones."""

REACTIVE_OF_PAPER: Final[Mapping[str, Mapping[str, Row]]] = {
    "success": {
        "ViNT": (0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
        "NoMaD": (0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
        "MBRA": (0.41, 0.18, 0.04, 0.03, 0.19, 0.00, 0.16, 0.01, 0.00),
        "InternVLA-N1": (0.30, 0.19, 0.18, 0.07, 0.22, 0.05, 0.12, 0.01, 0.00),
        "MIMIC": (0.39, 0.06, 0.01, 0.01, 0.01, 0.07, 0.52, 0.00, 0.27),
        "S2E": (0.69, 0.52, 0.40, 0.28, 0.17, 0.03, 0.66, 0.00, 0.00),
        "CityWalker": (0.48, 0.05, 0.02, 0.01, 0.00, 0.22, 0.55, 0.00, 0.00),
        "FlowPilot": (0.70, 0.42, 0.39, 0.45, 0.45, 0.08, 0.60, 0.11, 0.12),
        "OpenPilot": (0.78, 0.65, 0.44, 0.40, 0.38, 0.61, 0.77, 0.00, 0.09),
    },
    "pedestrian_collision": {
        "ViNT": (_NO, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
        "NoMaD": (_NO, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.20, 0.00),
        "MBRA": (_NO, 0.42, 0.50, 0.61, 0.48, 0.76, 0.42, 0.98, 0.31),
        "InternVLA-N1": (_NO, 0.06, 0.11, 0.30, 0.05, 0.33, 0.17, 0.17, 0.11),
        "MIMIC": (_NO, 0.13, 0.07, 0.06, 0.78, 0.58, 0.01, 0.94, 0.07),
        "S2E": (_NO, 0.12, 0.32, 0.44, 0.69, 0.85, 0.00, 1.00, 0.11),
        "CityWalker": (_NO, 0.73, 0.74, 0.76, 0.78, 0.41, 0.00, 1.00, 0.62),
        "FlowPilot": (_NO, 0.28, 0.33, 0.30, 0.38, 0.73, 0.10, 0.84, 0.32),
        "OpenPilot": (_NO, 0.13, 0.36, 0.31, 0.52, 0.26, 0.00, 1.00, 0.36),
    },
    "pedestrian_distance_min_success_m": {
        "ViNT": (_NO, _NO, _NO, _NO, _NO, _NO, _NO, _NO, _NO),
        "NoMaD": (_NO, _NO, _NO, _NO, _NO, _NO, _NO, _NO, _NO),
        "MBRA": (_NO, 0.79, 0.59, 0.54, 0.69, _NO, 0.66, 0.52, _NO),
        "InternVLA-N1": (_NO, 1.15, 1.36, 0.83, 1.43, 0.83, 0.95, 0.65, _NO),
        "MIMIC": (_NO, 0.88, 0.47, 1.02, 0.51, 0.96, 0.97, _NO, 2.01),
        "S2E": (_NO, 0.88, 0.80, 0.93, 0.82, 0.72, 0.97, _NO, _NO),
        "CityWalker": (_NO, 0.68, 0.68, 1.19, _NO, 0.92, 0.96, _NO, _NO),
        "FlowPilot": (_NO, 0.95, 0.81, 0.75, 0.92, 0.80, 0.85, 0.61, 1.37),
        "OpenPilot": (_NO, 0.93, 0.71, 0.64, 0.92, 1.03, 0.95, _NO, 1.04),
    },
}
"""Results by metric and model, in the order of EVENT_COLUMNS."""

LONG_OF_PAPER: Final[Mapping[str, Row]] = {
    "ViNT": (21.20, 4.29, 16.90, 0.00, 1.11, 27.52, 4.87, 8.24, 14.42, 0.39),
    "NoMaD": (14.17, 4.03, 10.14, 0.00, 1.32, 16.12, 5.44, 9.56, 1.12, 0.68),
    "MBRA": (10.26, 4.36, 5.91, 0.00, 0.99, 5.04, 3.55, 0.56, 0.93, 0.66),
    "InternVLA-N1": (14.92, 4.59, 10.33, 0.00, 1.45, 17.03, 5.43, 10.48, 1.12, 0.71),
    "MIMIC": (6.12, 2.96, 0.99, 2.16, 0.69, 11.98, 2.25, 0.00, 9.73, 0.38),
    "S2E": (5.43, 2.12, 3.25, 0.06, 0.46, 2.43, 1.50, 0.00, 0.94, 0.53),
    "CityWalker": (5.46, 3.53, 1.93, 0.00, 1.11, 3.74, 2.62, 0.56, 0.56, 0.78),
    "FlowPilot": (3.40, 2.30, 1.10, 0.00, 1.22, 1.69, 1.31, 0.00, 0.37, 0.73),
    "OpenPilot": (1.34, 1.01, 0.33, 0.01, 1.34, 0.94, 0.56, 0.00, 0.37, 0.83),
}
"""FC, C, OL, F per 100 m and V, m/s, in generated places, then in scanned ones."""
