"""Runs of a report: loaded, verified and refused if one table would mislead."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import pandas as pd

from cosim.core.errors import RunError, UsageError
from cosim.core.npz import read_npz
from cosim.core.progress import Progress, ignore
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.run_folder import RUN_AGAIN, load_log, trajectory_file
from cosim.results.run_spec import RunSpec, names_by_conditions
from cosim.results.table import table_of
from cosim.results.verified_run import VerifiedRun, read_verified_run
from cosim.spec.scenario import CityMap, Light, Scenario
from cosim.spec.weather import CLEAR, WEATHERS

PaperTable = Literal["unit", "reactive", "long"]
"""Short ways past things; short ways with at most one event; long ways, which continue after
failures."""
_COLUMNS: Final = ("pose", "speed", "travelled_m", "people_tick", "people_xy")
"""Columns that plots use; loading a whole log takes four times as long."""
PAPER_SUITES: Final = ("unit", "reactive", "long-horizon")
"""Suites shown together with the paper's rows."""
LIGHT_KINDS: Final = (
    "high sun",
    "low sun",
    "overcast",
    "fog",
    *(name for name in WEATHERS if name not in (CLEAR, "overcast", "fog")),
)
"""Kinds of light by the scenario's light, and of weather, which come before these."""
_OVERCAST: Final = 0.8
_LOW_SUN_DEG: Final = 20.0


@dataclass(frozen=True)
class ReportedRun:
    """Run of a report.

    label: name on the page: its policy, with robot, suite or folder if the policy is not unique

    The table has one row per episode: columns of `table_of`, and label, kind, family, place, real,
    light.
    """

    label: str
    whole: VerifiedRun

    @property
    def path(self) -> Path:
        return self.whole.path

    @property
    def spec(self) -> RunSpec:
        return self.whole.spec

    @property
    def scenarios(self) -> Mapping[str, Scenario]:
        return self.whole.scenarios

    @property
    def records(self) -> tuple[Record, ...]:
        """Records, sorted by scenario."""
        return tuple(self.whole.records.values())

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per episode, see the class."""
        table = table_of(self.records)
        of = [self.scenarios[name] for name in table["scenario"]]
        return table.assign(
            label=self.label,
            kind=[scenario_kind(one) for one in of],
            family=[table_of_paper(one) for one in of],
            place=[place_in_words(one) for one in of],
            real=[isinstance(one.place, CityMap) for one in of],
            light=[light_in_words(one) for one in of],
        )

    def log(self, scenario: str) -> Log | None:
        """Load the trajectory of an episode; None without one. Raises RunError if damaged."""
        if not trajectory_file(self.path, scenario).exists():
            return None
        return load_log(self.path, scenario)

    def tracks(self) -> Iterator[tuple[Record, Mapping[str, Any]]]:
        """Yield the record and _COLUMNS of the log of each "done" episode with a trajectory.

        Raises RunError for a damaged one.
        """
        for record in self.records:
            path = trajectory_file(self.path, record.scenario.id)
            if record.status != "done" or not path.exists():
                continue
            try:
                read = read_npz(path, _COLUMNS)
            except (OSError, ValueError) as error:
                raise RunError(f"{path}: not a trajectory: {error}: {RUN_AGAIN}") from error
            yield record, read


def read_runs(paths: Sequence[Path], progress: Progress = ignore) -> list[ReportedRun]:
    """Load the runs of a report.

    Raises UsageError for a run given twice, RunError for runs that cannot share a table, and
    whatever `read_verified_run` raises.
    """
    resolved = [path.resolve() for path in paths]
    for path, real in zip(paths, resolved, strict=True):
        if resolved.count(real) > 1:
            raise UsageError(f"{path} is given twice: name each run once")
    found = []
    for path in paths:
        progress(f"reading {path}")
        found.append(read_verified_run(path))
    _check_same_suites(found)
    names = names_by_conditions([whole.spec for whole in found])
    policies = [(whole.spec.suite, name) for whole, name in zip(found, names, strict=True)]
    suites = {
        policy: {suite for suite, other in policies if other == policy} for _, policy in policies
    }
    folders = [whole.path.name for whole in found]
    alike = {policy for policy in policies if policies.count(policy) > 1}
    names = [path.name if folders.count(path.name) == 1 else str(path) for path in paths]
    labels = [
        f"{policy}, {suite}" if suite not in PAPER_SUITES and len(suites[policy]) > 1 else policy
        for suite, policy in policies
    ]
    labels = [
        name if policy in alike else label
        for name, policy, label in zip(names, policies, labels, strict=True)
    ]
    rows = [(whole.spec.suite, label) for whole, label in zip(found, labels, strict=True)]
    return [
        ReportedRun(label if rows.count((suite, label)) == 1 else f"{label} ({path})", whole)
        for whole, path, (suite, label) in zip(found, paths, rows, strict=True)
    ]


def table_of_paper(scenario: Scenario) -> PaperTable:
    """Return which of the paper's three tables a scenario belongs to."""
    if not scenario.ends_on_failure:
        return "long"
    return "reactive" if scenario.events or scenario.structure == "static" else "unit"


def scenario_kind(scenario: Scenario) -> str:
    """Return the kind of a scenario: its structure, or the kind of its only event."""
    if not scenario.structure and scenario.ends_on_failure and len(scenario.events) == 1:
        return scenario.events[0].kind
    return scenario.structure or ("route" if not scenario.ends_on_failure else "other")


def place_in_words(scenario: Scenario) -> str:
    """Return the place of a scenario, such as "berlin-3" or "city 17"."""
    where = scenario.place
    if isinstance(where, CityMap):
        return where.map
    return f"city {where.seed}" + (f" ({where.size_m:g} m)" if where.size_m != 2000.0 else "")


def light_in_words(scenario: Scenario) -> str:
    """Return one of LIGHT_KINDS: weather before fog, clouds and the sun's elevation."""
    if (weather := scenario.conditions.name) != CLEAR:
        return weather
    light = scenario.light
    if light.fog_m is not None:
        return "fog"
    if light.cloud_cover >= _OVERCAST:
        return "overcast"
    return "low sun" if sun_deg(light) < _LOW_SUN_DEG else "high sun"


def sun_deg(light: Light) -> float:
    """Return the sun's elevation, degrees, from hour, day and latitude."""
    declination = math.radians(-23.44) * math.cos(2.0 * math.pi * (light.day_of_year + 10) / 365.25)
    latitude = math.radians(light.latitude_deg)
    hour = math.radians(15.0 * (light.hour - 12.0))
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(
        declination
    ) * math.cos(hour)
    return math.degrees(math.asin(max(-1.0, min(1.0, up))))


def _check_same_suites(runs: Sequence[VerifiedRun]) -> None:
    """Raise RunError for two runs whose suites have the same name but different content."""
    first: dict[str, VerifiedRun] = {}
    for run in runs:
        other = first.setdefault(run.spec.suite, run)
        if other.spec.setup.suite_hash != run.spec.setup.suite_hash:
            raise RunError(
                f"{run.path} and {other.path} are of different suites '{run.spec.suite}' "
                f"({run.spec.setup.suite_hash}, {other.spec.setup.suite_hash}): their rows "
                "cannot be in one table. Report them separately, or run one again"
            )
