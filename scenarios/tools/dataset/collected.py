"""Collected episodes, and what data sets of them must have in common; needs no pyarrow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from cosim.core.errors import SpecError
from cosim.results.record import Record
from cosim.spec.scenario import Scenario
from scenarios.episodes.demonstration import Demonstration

ABOUT: Final = "about.json"
"""File of a collection of the format raw, with the options of its collection."""
RUNS: Final = "runs"
"""Folder of the run folders of a collection."""
_SAME: Final = ("rate_hz", "waypoint_s", "waypoints", "goal", "camera", "robot")
"""Requirement for data sets that are merged into one file."""
_SENSORS: Final = {"lidar": None, "imu": "none", "people": "none"}
"""Sensors that must be the same too, with the value of a data set that does not state them."""


@dataclass(frozen=True)
class Collected:
    """Accepted episode. load: reads its demonstration from the disk at each call."""

    scenario: Scenario
    record: Record
    load: Callable[[], Demonstration]


def refuse_unlike(held: Sequence[tuple[Path, dict[str, Any]]]) -> None:
    """Raise SpecError for data sets that do not match. held: folder and options of each."""
    for (folder, about), (other, theirs) in pairwise(held):
        for name in (*_SAME, *_SENSORS):
            mine, others = _stated(about, name), _stated(theirs, name)
            if mine != others:
                raise SpecError(f"{folder} and {other}: {name} is {mine} here and {others} there")


def packed_meta(
    abouts: Sequence[dict[str, Any]], episodes: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Return `Packed.meta`.

    abouts: options of each data set.
    episodes: scenario, structure and weather of each.
    """
    return {name: _stated(abouts[0], name) for name in (*_SAME, *_SENSORS)} | {
        "policy": [about["policy"] for about in abouts],
        "noise": [about["noise"] for about in abouts],
        "learner": [about.get("learner", "") for about in abouts],
        "explorer": [about.get("explorer", "") for about in abouts],
        "scenarios": [one["scenario"] for one in episodes],
        "structures": [one["structure"] for one in episodes],
        "weathers": [one["weather"] for one in episodes],
    }


def _stated(about: dict[str, Any], name: str) -> Any:
    """Return an option of a collection."""
    return about.get(name, _SENSORS[name]) if name in _SENSORS else about[name]
