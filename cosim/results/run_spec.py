"""RunSpec: what a run is; and Shard, the part of one that a folder holds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from cosim.core.errors import RunError, UsageError
from cosim.results.flat_file import FlatFile
from cosim.results.run_setup import RunSetup
from cosim.spec.manifest import Manifest
from cosim.spec.scenario import Suite
from cosim.spec.selection import selection_in_words

_T = TypeVar("_T")
SCHEMA = 1
"""Raised whenever run.json changes its meaning; other schemas are refused."""
_MAY_DIFFER = {"policy_name", "shared_renderer", "schema"}
"""Keys of run.json in which runs may differ and be the same run."""
_ARITHMETIC = (
    " Of two machines whose arithmetic is apart the processors or C libraries round differently: "
    "episodes of one are not those of the other to the bit."
)

_OF_SUITE = ("suite_version", "suite_hash")
_OTHER_SUITE = (
    " The suite was edited; or --robot, --crowd and the like differ; or, with --map, --seed, "
    "--episodes or --event do."
)


class Shard(msgspec.Struct, frozen=True):
    """Every `of`-th scenario of a run, beginning with the `number`-th, which counts from 1."""

    number: int
    of: int

    @classmethod
    def called(cls, words: str, scenarios: int) -> Shard:
        """The one that "2/8" names, of a run of so many scenarios. Raises UsageError."""
        found = re.fullmatch(r"([1-9][0-9]{0,5})/([1-9][0-9]{0,5})", words, re.ASCII)
        number, of = (int(part) for part in found.groups()) if found else (0, 0)
        if not 0 < number <= of:
            raise UsageError(
                f"--shard {words}: give i/n, with i from 1 to n, such as 1/4, 2/4, 3/4 and 4/4"
            )
        if of > scenarios:
            raise UsageError(
                f"--shard {words}: the run has {scenarios} scenarios, and more shards than "
                f"that are empty"
            )
        return cls(number, of)

    @property
    def in_words(self) -> str:
        return f"{self.number}/{self.of}"

    def share(self, whole: Sequence[_T]) -> list[_T]:
        """What of the whole run is this shard's."""
        return list(whole[self.number - 1 :: self.of])


class Apart(NamedTuple):
    """A field in which two runs are not the same, with both values in words, and what else is to be
    said of it."""

    field: str
    mine: str
    theirs: str
    hint: str


class _Schema(msgspec.Struct):
    """The part of a run.json that says how the rest is to be read."""

    schema: int = 1


class RunSpec(msgspec.Struct, frozen=True, kw_only=True):
    """What a run is. Two runs with the same RunSpec have the same results.

    robots: which drive, and the hash of each. policy: the name that loads it. manifest: of the
    policy, with the goals of the run; run.json does not hold its `privileged` and `goals`, so a
    spec that was read has their defaults. scenarios: of the whole run; shard: which part of them
    the folder holds, where it is not all. counterfactual: whether each episode is compared with its
    street without the robot. shared_renderer: whether one process drew for all others when it
    began; what comes out is the same.
    """

    suite: str
    robots: dict[str, str]
    suite_version: str
    policy: str
    manifest: Manifest
    setup: RunSetup
    scenarios: tuple[str, ...]
    counterfactual: bool = False
    shared_renderer: bool = False
    shard: Shard | None = None
    schema: int = SCHEMA

    def apart(self, other: RunSpec, but: str = "", whole: Suite | None = None) -> Apart | None:
        """The first field in which another run is not the same; None where it is. but: a field that
        may differ. whole: the suite of both, for words about which of its scenarios they have."""
        others = RUN_FILE.flat(other)
        for field, mine in RUN_FILE.flat(self).items():
            theirs = others[field]
            if mine == theirs or field == but or field in _MAY_DIFFER:
                continue
            if field == "scenarios":
                return _chosen_apart(self.scenarios, other.scenarios, whole)
            changed: set[str] = set()
            if isinstance(mine, dict) and isinstance(theirs, dict):
                changed = {
                    name
                    for name in mine.keys() | theirs.keys()
                    if mine.get(name) != theirs.get(name)
                }
                mine, theirs = ({n: of.get(n) for n in sorted(changed)} for of in (mine, theirs))
            hint = (
                _ARITHMETIC
                if "arithmetic" in changed
                else _OTHER_SUITE
                if field in _OF_SUITE
                else ""
            )
            return Apart(field, brief(mine), brief(theirs), hint)
        return None


RUN_FILE = FlatFile(
    RunSpec,
    {"setup": RunSetup, "manifest": Manifest},
    """
    suite robots suite_version suite_hash policy policy_name=manifest.name
    policy_version=manifest.version policy_source policy_runs waypoints camera cameras rate_hz
    goal_protocol=manifest.goal odometry latency_ms real_time seed scenarios versions renderer
    counterfactual shared_renderer metric_schema shard schema
    """,
    without="manifest.privileged manifest.goals",
    defaults={"camera": None, "renderer": "unknown"},
)
"""The layout of run.json, which is older than the parts of a `RunSpec`."""


def _chosen_apart(mine: Sequence[str], theirs: Sequence[str], whole: Suite | None) -> Apart:
    """How many scenarios two runs of a suite have, and by which options, or else one that only one
    of them has."""
    if whole is None:
        return Apart("choice of scenarios", _counted(mine, theirs), _counted(theirs, mine), "")
    return Apart(
        "choice of scenarios",
        selection_in_words(whole, mine),
        selection_in_words(whole, theirs),
        "",
    )


def _counted(ids: Sequence[str], others: Sequence[str]) -> str:
    """How many scenarios, and one of them that is not among the others."""
    more = next((f", with {name}" for name in ids if name not in others), "")
    return f"{len(ids)}{more}"


def decoded_spec(data: bytes, where: Path) -> RunSpec:
    """What the bytes of a run.json say. where: what an error names. Raises RunError for another
    schema, ValueError for bytes that are no run.json."""
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
    """A value in words, in at most 80 letters."""
    text = str(getattr(value, "in_words", value))
    return text if len(text) <= 80 else text[:77] + "..."
