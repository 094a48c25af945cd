"""Specification of a run and of its shards: run.json."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from cosim.core.errors import RunError, UsageError
from cosim.episode.manifest_checks import fault_of_values
from cosim.results.flat_file import FlatFile
from cosim.results.run_setup import RunSetup, gait_in_words
from cosim.spec.manifest import Manifest
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Suite
from cosim.spec.selection import selection_in_words

_T = TypeVar("_T")
SCHEMA = 1
"""Version of the meaning of run.json; other versions are refused."""
_MAY_DIFFER = {"policy_name", "shared_renderer", "schema"}
"""Keys of run.json that may differ between two starts of the same run."""
_ARITHMETIC_HINT = (
    " The processors or C libraries of the two machines round differently, so that episodes of one "
    "are not bit-identical to those of the other."
)
"""Hint for runs with another `arithmetic` hash in their versions."""

_SUITE_FIELDS = ("suite_version", "suite_hash")
_SUITE_HINT = (
    " Either the suite was edited, or options of the crowd such as --crowd differ; with --map also "
    "--robot, --seed, --episodes or --event."
)
"""Hint for runs whose suites differ."""


class Shard(msgspec.Struct, frozen=True):
    """Part of a run: every `of`-th scenario, from the `number`-th on, counted from 1.

    A decoy is in the shard of its scenario.
    """

    number: int
    of: int

    @classmethod
    def parse(cls, text: str, scenarios: int) -> Shard:
        """Parse a shard such as "2/8" for a run of `scenarios` scenarios. Raises UsageError.

        >>> Shard.parse("2/8", scenarios=40).in_words
        '2/8'
        """
        found = re.fullmatch(r"([1-9][0-9]{0,5})/([1-9][0-9]{0,5})", text, re.ASCII)
        number, of = (int(part) for part in found.groups()) if found else (0, 0)
        if not 0 < number <= of:
            raise UsageError(
                f"--shard {text}: give i/n, with i from 1 to n, such as 1/4, 2/4, 3/4 and 4/4"
            )
        if of > scenarios:
            raise UsageError(
                f"--shard {text}: the run has {scenarios} scenarios, and more shards than "
                f"that are empty"
            )
        return cls(number, of)

    @property
    def in_words(self) -> str:
        """The shard as in `--shard`."""
        return f"{self.number}/{self.of}"

    def select(self, items: Sequence[_T]) -> list[_T]:
        """Return the items of this shard, in their order."""
        return list(items[self.number - 1 :: self.of])


class SpecDifference(NamedTuple):
    """First difference between two runs: field, both values in words, and a hint."""

    field: str
    mine: str
    theirs: str
    hint: str


class _Schema(msgspec.Struct):
    """Schema version of a run.json."""

    schema: int = 1


class RunSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Specification of a run: two runs with the same RunSpec have the same results.

    robots: hash of each robot by name
    policy: name that loads the policy
    manifest: includes the goals of the run; run.json omits `privileged` and `goals`, which a loaded
        spec has as defaults
    scenarios: ids of the whole run
    shard: part of the run in this folder, None for all
    weather: weather in place of the scenarios' own, "" for their own
    counterfactual: whether each episode is compared with its street without the robot
    shared_renderer: whether one process drew for all others; results do not depend on it
    """

    suite: str
    robots: dict[str, str]
    suite_version: str
    policy: str
    manifest: Manifest
    setup: RunSetup
    scenarios: tuple[str, ...]
    weather: str = ""
    counterfactual: bool = False
    shared_renderer: bool = False
    shard: Shard | None = None
    schema: int = SCHEMA

    @property
    def robots_in_words(self) -> str:
        """Names and short hashes of robots and gait; "" for the defaults."""
        robots = [f"robot {n} ({h[:8]})" for n, h in self.robots.items() if n != COURIER.name]
        if self.setup.gait:
            robots.append(gait_in_words(self.setup.gait, self.setup.gait_hash))
        return ", ".join(robots)

    @property
    def conditions_in_words(self) -> str:
        """Robots and gait as in `robots_in_words`, and the weather; "" for the defaults."""
        weather = f"weather {self.weather}" if self.weather else ""
        return ", ".join(filter(None, (self.robots_in_words, weather)))

    def difference_from(
        self, other: RunSpec, ignored: str = "", suite: Suite | None = None
    ) -> SpecDifference | None:
        """Return the first field in which another run differs; None if they are the same run.

        ignored: field that may differ
        suite: suite of both runs, to describe the choice of scenarios
        """
        others = RUN_FILE.flat(other)
        for field, mine in RUN_FILE.flat(self).items():
            theirs = others[field]
            if mine == theirs or field == ignored or field in _MAY_DIFFER:
                continue
            if field == "scenarios":
                return _choice_difference(self.scenarios, other.scenarios, suite)
            changed: set[str] = set()
            if isinstance(mine, dict) and isinstance(theirs, dict):
                changed = {
                    name
                    for name in mine.keys() | theirs.keys()
                    if mine.get(name) != theirs.get(name)
                }
                mine, theirs = (
                    {name: values.get(name) for name in sorted(changed)}
                    for values in (mine, theirs)
                )
            hint = (
                _ARITHMETIC_HINT
                if "arithmetic" in changed
                else _SUITE_HINT
                if field in _SUITE_FIELDS
                else ""
            )
            return SpecDifference(field, brief(mine), brief(theirs), hint)
        return None


RUN_FILE = FlatFile(
    RunSpec,
    {"setup": RunSetup, "manifest": Manifest},
    """
    suite robots weather suite_version suite_hash policy policy_name=manifest.name
    policy_version=manifest.version policy_source policy_runs waypoints camera cameras rate_hz
    goal_protocol=manifest.goal odometry lidar=manifest.scan imu=manifest.imu
    people=manifest.people latency_ms real_time
    seed scenarios versions renderer gait gait_hash counterfactual shared_renderer metric_schema
    shard schema
    """,
    without="manifest.privileged manifest.goals",
    defaults={"camera": None, "renderer": "unknown"},
    fault=lambda spec: fault_of_values(spec.manifest),
)
"""Layout of run.json: flat, for compatibility with files written before `RunSpec` had parts."""


def names_by_conditions(specs: Sequence[RunSpec]) -> list[str]:
    """Return the policy name of each run, with robots and weather if the policy had others, too."""
    robots = {spec.manifest.name: set[str]() for spec in specs}
    weathers = {spec.manifest.name: set[str]() for spec in specs}
    for spec in specs:
        robots[spec.manifest.name].add(_robot_names(spec))
        weathers[spec.manifest.name].add(spec.weather)
    return [
        _varied_in_words(spec, robots[name], weathers[name])
        for spec in specs
        for name in [spec.manifest.name]
    ]


def _varied_in_words(spec: RunSpec, robots: set[str], weathers: set[str]) -> str:
    """Return robots and weather of a run, as far as these differ between runs of its policy."""
    words = [spec.manifest.name]
    if len(robots) > 1:
        words.append(_robot_names(spec))
    if len(weathers) > 1:
        words.append(spec.weather or "own weather")
    return ", ".join(words)


def _robot_names(spec: RunSpec) -> str:
    return " and ".join(sorted(spec.robots))


def _choice_difference(
    mine: Sequence[str], theirs: Sequence[str], suite: Suite | None
) -> SpecDifference:
    """Describe the different choice of scenarios of two runs of a suite."""
    if suite is None:
        return SpecDifference(
            "choice of scenarios", _count_in_words(mine, theirs), _count_in_words(theirs, mine), ""
        )
    return SpecDifference(
        "choice of scenarios",
        selection_in_words(suite, mine),
        selection_in_words(suite, theirs),
        "",
    )


def _count_in_words(ids: Sequence[str], others: Sequence[str]) -> str:
    """Return the number of scenarios, and one that is not among the others."""
    more = next((f", with {name}" for name in ids if name not in others), "")
    return f"{len(ids)}{more}"


def decode_spec(data: bytes, where: Path) -> RunSpec:
    """Decode a run.json.

    where: path named in errors.

    Raises RunError for another schema, ValueError for bytes that are no run.json.
    """
    try:
        if (schema := msgspec.json.decode(data, type=_Schema).schema) != SCHEMA:
            raise RunError(
                f"{where}: run schema {schema}, and this version reads {SCHEMA}: use the version "
                "of cosim that made the run, which is in its `versions`"
            )
        return RUN_FILE.decode(data)
    except RecursionError as error:
        raise ValueError("brackets within brackets within brackets") from error


def brief(value: object) -> str:
    """Return a value in words, in at most 80 characters."""
    text = str(getattr(value, "in_words", value))
    return text if len(text) <= 80 else text[:77] + "..."
