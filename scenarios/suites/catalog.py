"""Catalog of the shipped suites by name, and loading of suites and single scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType

import msgspec

from cosim.core.errors import UsageError, unknown
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Suite, read_suite
from cosim.spec.selection import select_scenarios
from scenarios.events import EVENT_KINDS

_HERE = Path(__file__).parent
_OF_RUN = "scenarios.json"
"""File of a run folder with its scenarios."""

_NAMES = ("unit", "reactive", "long-horizon", "scans")
_FILES = {name: _HERE / f"{name}.json" for name in _NAMES}
SUITES: Mapping[str, Path] = MappingProxyType(
    {name: path for name, path in _FILES.items() if path.exists()}
)


def load_suite(name: str) -> Suite:
    """Load a shipped suite by name, or one of the user's by the path of its .json file, of an own
    scenario's .toml, or of a run folder.

    Raises UsageError with the valid names, SpecError naming the file and the field.

    >>> load_suite("long-horizon").scenarios[0].id
    'lh-001-00'
    """
    if name.endswith(".json"):
        return read_suite(Path(name), EVENT_KINDS)
    if name.endswith(".toml"):
        return _own(Path(name))
    if name not in SUITES and _is_run(name):
        return read_suite(Path(name) / _OF_RUN, EVENT_KINDS)
    if name not in SUITES:
        raise unknown("suite", name, [*SUITES, "path/to/suite.json", "path/to/own.toml"])
    return _shipped(name)


def _is_run(name: str) -> bool:
    return (Path(name) / _OF_RUN).is_file()


@cache
def _shipped(name: str) -> Suite:
    """Read a shipped suite, once per process."""
    return read_suite(SUITES[name], EVENT_KINDS)


def _own(path: Path) -> Suite:
    from scenarios.suites.user_scenarios.build import suite_of_own
    from scenarios.suites.user_scenarios.read import read_own

    own = read_own(path)
    for goal in filter(None, dict.fromkeys(variant.own.goal_protocol for variant in own.variants)):
        raise UsageError(
            f"{path}: goal_protocol '{goal}' is of a run: use `cosim scenario run {path}`, "
            f"or delete it and give --goal"
        )
    return suite_of_own(own)


def suite_with_scenario(scenario_id: str) -> Suite:
    """Return the shipped suite with a scenario of this id. Raises UsageError with the valid
    names.
    """
    ids: list[str] = []
    for name in SUITES:
        suite = load_suite(name)
        if scenario_id in (here := [s.id for s in suite.scenarios]):
            return suite
        ids += here
    raise UsageError(
        f"{unknown('scenario', scenario_id, ids)} For one that was drawn by --map, give the run "
        "folder by --suite."
    )


def one_scenario(
    name: str, suite: str | None = None, which: str | None = None
) -> tuple[Suite, int]:
    """Find one scenario by its id, or by its suite: the suite with it alone, and of how many it is
    one.

    name: id of a scenario, name of a shipped suite, path of a file, or a run folder
    suite: where to look for the id; by default in the shipped suites.
    which: of all but an id: the id or the number, counted from 1; by default the first.

    Raises UsageError with the valid choices, SpecError for a file with faults.
    """
    if not name.endswith((".json", ".toml")) and not _is_run(name) and name not in SUITES:
        if which is not None:
            raise UsageError(
                f"--scenario chooses from a suite or a file, and '{name}' is not a suite's name; "
                f"for a scenario's id, leave --scenario out. Suites: {', '.join(SUITES)}"
            )
        found = suite_with_scenario(name) if suite is None else load_suite(suite)
        return msgspec.structs.replace(found, scenarios=select_scenarios(found, [name])), 1
    if suite is not None:
        raise UsageError(
            f"{name} is a suite or a file: leave --suite out, and choose one of its scenarios by "
            "--scenario"
        )
    if not name.endswith(".toml"):
        found = load_suite(name)
        one = _picked([scenario.id for scenario in found.scenarios], which)
        return msgspec.structs.replace(found, scenarios=(found.scenarios[one],)), len(
            found.scenarios
        )
    from scenarios.suites.user_scenarios.build import build_scenario, suite_of
    from scenarios.suites.user_scenarios.read import read_own

    own = read_own(Path(name))
    variant = own.variants[_picked([variant.id for variant in own.variants], which)]
    return suite_of(own, [build_scenario(variant, own.name)]), len(own.variants)


def _picked(ids: Sequence[str], which: str | None) -> int:
    """Return the index of the scenario with this id or number; 0 for None."""
    if which is None:
        return 0
    if which in ids:
        return ids.index(which)
    if which.isdecimal() and 1 <= int(which) <= len(ids):
        return int(which) - 1
    raise UsageError(f"{unknown('scenario', which, ids)} Or its number, 1 to {len(ids)}.")


def with_crowd(suite: Suite, **crowd_fields: float | None) -> Suite:
    """Return the suite with these fields of `CrowdSpec` in each scenario.

    It is another suite, with another version. Fields that are None stay unchanged. A number of
    persons replaces a density. Raises SpecError for an invalid crowd.
    """
    changes = {field: value for field, value in crowd_fields.items() if value is not None}
    if not changes:
        return suite
    replace = msgspec.structs.replace
    fields = {"density": None, **changes} if "persons" in changes else changes
    scenarios = tuple(
        replace(s, crowd=replace(s.crowd, **fields, added=True)) for s in suite.scenarios
    )
    version = "-".join([suite.version, *(f"{field}{value:g}" for field, value in changes.items())])
    return replace(suite, scenarios=scenarios, version=version)


def with_robot(suite: Suite, robot: str) -> Suite:
    """Return the suite with this robot in each scenario.

    The robot belongs to a run, not to its suite: the identity of a run has the `content_hash` of
    the suite without it. The suite is returned unchanged if it has this robot, or if `robot` is "".
    Raises UsageError with the valid names, and SpecError for a robot whose row or URDF is invalid.
    """
    if robot:
        from physics.robots.check import check_robot  # imported only where needed: loads OpenCV

        check_robot(robot_called(robot))
    scenarios = tuple(scenario.driven_by(robot) for scenario in suite.scenarios)
    if scenarios == suite.scenarios:
        return suite
    return msgspec.structs.replace(suite, scenarios=scenarios)


def with_weather(suite: Suite, weather: str) -> Suite:
    """Return the suite in this weather; unchanged if `weather` is "". Raises SpecError.

    Like the robot, the weather belongs to a run, not to its suite.
    """
    if not weather:
        return suite
    scenarios = tuple(scenario.in_weather(weather) for scenario in suite.scenarios)
    return msgspec.structs.replace(suite, scenarios=scenarios)
