"""Compare runs of one suite, scenario by scenario, with paired statistics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from cosim.core.errors import RunError, UsageError
from cosim.core.geometry import Floats
from cosim.results.finished_run import WholeRun, read_whole_run
from cosim.results.metrics import COUNTERFACTUAL, METRICS, POOLED, RATE_NEEDS_M
from cosim.results.table import (
    BOOTSTRAP,
    CONFIDENCE,
    injections_in_words,
    not_to_be_quoted,
    numbers,
    table_of,
)
from cosim.spec.scenario import Scenario

FEWEST_CHANGED: Final = 6
PairedVerdict = Literal["within noise", "too few", "better", "worse", "differs"]


class PairedDifference(NamedTuple):
    """before, after: over the pairs in which both have a value; NaN where none has one. low, high:
    of after - before. n: such pairs; changed: those of them that are not the same in both, and of a
    rate had something counted in one."""

    before: float
    after: float
    low: float
    high: float
    n: int
    changed: int

    @property
    def difference(self) -> float:
        return self.after - self.before

    def verdict(self, higher_is_better: bool | None) -> PairedVerdict:
        """In words, of a metric of which more is better, worse, or neither (None)."""
        if not self.n or self.low <= 0.0 <= self.high:
            return "within noise"
        if self.changed < FEWEST_CHANGED:
            return "too few"
        if higher_is_better is None:
            return "differs"
        return "better" if (self.low > 0.0) == higher_is_better else "worse"


def difference_of_means(before: Floats, after: Floats) -> PairedDifference:
    """Of two runs of the same (N,) scenarios, NaN where a value does not exist: such a pair is left
    out."""
    both = ~(np.isnan(before) | np.isnan(after))
    before, after = before[both], after[both]
    n = len(before)
    changes = after - before
    if not n:
        return PairedDifference(math.nan, math.nan, math.nan, math.nan, 0, 0)
    low, high = _interval(changes[_draws(n)].sum(axis=1) / n, n) if changes.any() else (0.0, 0.0)
    return PairedDifference(
        float(before.mean()), float(after.mean()), low, high, n, int(np.count_nonzero(changes))
    )


def difference_of_rates(
    before: tuple[Floats, Floats], after: tuple[Floats, Floats], per: float = 100.0
) -> PairedDifference:
    """Of pooled rates: of each run what was counted (N,) and the metres (N,) it is counted on. All
    that was counted on all metres of the scenarios that are drawn, in both runs the same ones."""
    columns = np.array([*before, *after])
    columns = columns[:, ~np.isnan(columns).any(axis=0)]
    n = columns.shape[1]
    if not n or min(columns[1].sum(), columns[3].sum()) < RATE_NEEDS_M:
        return PairedDifference(math.nan, math.nan, math.nan, math.nan, 0, 0)
    counted, metres, counted_after, metres_after = columns
    rates = per * counted.sum() / metres.sum(), per * counted_after.sum() / metres_after.sum()
    apart = (counted != counted_after) | (metres != metres_after)
    changed = int((apart & ((counted > 0.0) | (counted_after > 0.0))).sum())
    if not apart.any() or not (counted.any() or counted_after.any()):
        return PairedDifference(*rates, 0.0, 0.0, n, 0)
    drawn = [column[_draws(n)].sum(axis=1) for column in columns]
    moved = (drawn[1] > 0.0) & (drawn[3] > 0.0)
    counted, metres, counted_after, metres_after = (column[moved] for column in drawn)
    low, high = _interval(per * (counted_after / metres_after - counted / metres), n)
    return PairedDifference(*rates, low, high, n, changed)


def _interval(differences: Floats, n: int) -> tuple[float, float]:
    """The middle of what was drawn of n pairs; none for one pair, which has no spread."""
    if n < 2 or not len(differences):
        return math.nan, math.nan
    t = stdtrit(n - 1, 0.5 + CONFIDENCE / 2)
    tail = float(ndtr(-t * math.sqrt(n / (n - 1))))
    low, high = np.quantile(differences, [tail, 1.0 - tail])
    return float(low), float(high)


@lru_cache(maxsize=8)
def _draws(n: int) -> NDArray[np.int64]:
    """(BOOTSTRAP, n) which of n pairs are drawn."""
    draws = np.random.default_rng(0).integers(n, size=(BOOTSTRAP, n))
    draws.flags.writeable = False
    return draws


DIFFERENCES: Final = (
    "before",
    "after",
    "by",
    "group",
    "metric",
    "unit",
    "n",
    "value_before",
    "value_after",
    "difference",
    "low",
    "high",
    "changed",
    "verdict",
)
FLIPPED: Final = (
    "before",
    "after",
    "scenario",
    "split",
    "structure",
    "flip",
    "ended_before",
    "ended_after",
)

Groups = Mapping[tuple[str, str], frozenset[str]]
"""Scenario ids by what they have in common: ("suite" | "event" | "structure" | "split", its
name)."""


class ComparedRun(NamedTuple):
    """label: what it is called in tables; table: a row per episode, as in results.csv."""

    label: str
    path: Path
    table: pd.DataFrame


class RunComparison(NamedTuple):
    """before: the run that the others are compared with. differences, flipped: a row each,
    `DIFFERENCES`, `FLIPPED`. notes: what a reader of these must know."""

    suite: str
    before: ComparedRun
    others: tuple[ComparedRun, ...]
    differences: pd.DataFrame
    flipped: pd.DataFrame
    notes: tuple[str, ...]


def compare_runs(paths: Sequence[Path]) -> RunComparison:
    """The first run with each of the others. Raises UsageError for fewer than two, what
    `read_whole_run` raises, and RunError, naming folder and remedy, for runs that are of different
    suites, or share no scenario."""
    if len(paths) < 2:
        raise UsageError("a comparison needs two runs or more: cosim compare RUN OTHER ...")
    runs = [read_whole_run(path) for path in paths]
    for run in runs:
        _check_suites(runs[0], run)
    before, *others = (
        ComparedRun(label, run.path, table_of(run.records.values()))
        for label, run in zip(_labels(runs), runs, strict=True)
    )
    groups = groups_of(runs[0].spec.suite, runs[0].scenarios.values())
    pairs = [(before, other) for other in others]
    compared = [differences_of(*pair, groups, judged=not _terms_apart(*pair)) for pair in pairs]
    differences = pd.concat(compared, ignore_index=True)
    flipped = pd.concat([flipped_between(*pair) for pair in pairs], ignore_index=True)
    notes = (*_notes(runs, [before, *others]), *_lonely(pairs))
    return RunComparison(runs[0].spec.suite, before, tuple(others), differences, flipped, notes)


def groups_of(suite: str, scenarios: Iterable[Scenario]) -> dict[tuple[str, str], frozenset[str]]:
    """The whole suite, and by event (who has it on the way), structure and split; none that is the
    same as another."""
    members: dict[tuple[str, str], set[str]] = {}
    for one in scenarios:
        kinds = dict.fromkeys(event.kind for event in one.events)
        named = [("suite", suite), *(("event", kind) for kind in kinds)]
        for key in [*named, ("structure", one.structure), ("split", one.split)]:
            members.setdefault(key, set()).add(one.id)
    order = ("suite", "event", "structure", "split")
    found: dict[tuple[str, str], frozenset[str]] = {}
    for key in sorted(members, key=lambda key: order.index(key[0])):
        if key[1] and frozenset(members[key]) not in found.values():
            found[key] = frozenset(members[key])
    return found


def differences_of(
    before: ComparedRun,
    after: ComparedRun,
    groups: Groups,
    names: Sequence[str] = (),
    judged: bool = True,
) -> pd.DataFrame:
    """A row for each group and metric, `DIFFERENCES`: over the scenarios that both runs have.
    names: of metrics; all that both have where none is named. judged: whether a difference is
    called better or worse; else it "differs"."""
    one, other = (run.table.set_index("scenario") for run in (before, after))
    ids = [name for name in one.index if name in other.index]
    names = names or [
        name
        for name in (*METRICS, *COUNTERFACTUAL)
        if name in one.columns and name in other.columns
    ]
    rows = []
    for (by, group), members in groups.items():
        inside = [name for name in ids if name in members]
        if not inside:
            continue
        pair = one.loc[inside], other.loc[inside]
        for name in names:
            found = _difference(name, *pair)
            unit, better = METRICS[name][:2] if name in METRICS else (COUNTERFACTUAL[name], None)
            values = (
                found.n,
                found.before,
                found.after,
                found.difference,
                found.low,
                found.high,
                found.changed,
            )
            verdict = found.verdict(better if judged else None) if found.n else ""
            rows.append((before.label, after.label, by, group, name, unit, *values, verdict))
    return pd.DataFrame(rows, columns=list(DIFFERENCES))


def _difference(name: str, before: pd.DataFrame, after: pd.DataFrame) -> PairedDifference:
    """Of a metric, over rows of the same scenarios. A rate has none where a policy crashed: what it
    would have done after that cannot be counted."""
    if name not in POOLED:
        return difference_of_means(numbers(before, name), numbers(after, name))
    if "crashed" in {*before["status"], *after["status"]}:
        return PairedDifference(math.nan, math.nan, math.nan, math.nan, 0, 0)
    counted, metres = POOLED[name]
    one, other = ((numbers(table, counted), numbers(table, metres)) for table in (before, after))
    return difference_of_rates(one, other)


def flipped_between(before: ComparedRun, after: ComparedRun) -> pd.DataFrame:
    """A row for each scenario that one run solved and the other did not, `FLIPPED`: "won" by the
    second, or "lost"."""
    one, other = (run.table.set_index("scenario") for run in (before, after))
    rows = []
    for name in one.index.intersection(other.index):
        mine, theirs = one.loc[name], other.loc[name]
        if (
            pd.notna(mine["success"])
            and pd.notna(theirs["success"])
            and mine["success"] != theirs["success"]
        ):
            flip = "won" if theirs["success"] > mine["success"] else "lost"
            ends = (
                str(row["ended"] if row["status"] == "done" else row["status"])
                for row in (mine, theirs)
            )
            rows.append(
                (before.label, after.label, name, mine["split"], mine["structure"], flip, *ends)
            )
    return pd.DataFrame(rows, columns=list(FLIPPED))


def _check_suites(one: WholeRun, other: WholeRun) -> None:
    """Raises RunError where two runs are not of the same suite, or share no scenario."""
    mine, theirs = one.spec, other.spec
    my_hash, their_hash = mine.setup.suite_hash, theirs.setup.suite_hash
    if my_hash != their_hash:
        what = (
            "the same suite"
            if mine.suite != theirs.suite
            else "the same version of it (edited, robot, --crowd?)"
        )
        raise RunError(
            f"{other.path} is of suite '{theirs.suite}' {theirs.suite_version} ({their_hash}), "
            f"{one.path} of '{mine.suite}' {mine.suite_version} ({my_hash}): run both on {what}"
        )
    if not one.records.keys() & other.records.keys():
        raise RunError(
            f"{other.path} has no scenario that {one.path} has: run both with the same "
            f"--scenario, --episodes"
        )


def _labels(runs: Sequence[WholeRun]) -> list[str]:
    """What runs are called: by their policies where these are apart, else by their folders, and
    numbers."""
    names = [run.spec.manifest.name for run in runs]
    if len({*names}) < len(names):
        names = [run.path.absolute().name for run in runs]
    return [
        f"{name} ({names[:i].count(name) + 1})" if name in names[:i] else name
        for i, name in enumerate(names)
    ]


def _notes(runs: Sequence[WholeRun], told: Sequence[ComparedRun]) -> Iterator[str]:
    """What makes runs unlike in more than their policies, and what is not to be quoted."""
    for run, one in zip(runs, told, strict=True):
        if reason := not_to_be_quoted(one.table, len(run.spec.scenarios)):
            yield f"{one.label} is not to be quoted: {reason}"
        if odd := next(
            (record.nonstandard for record in run.records.values() if record.nonstandard), ""
        ):
            yield f"{one.label} is nonstandard: {odd}"
        if words := injections_in_words(one.table):
            yield f"{one.label}: {words}"
        crashed = sum(record.status == "crashed" for record in run.records.values())
        if crashed:
            yield (
                f"{one.label}: {crashed} crashed, counted as the worst there is; groups with "
                f"them have no rates"
            )
        first = runs[0].spec.setup
        if terms := _terms_apart(told[0], one):
            yield (
                f"No verdict of {one.label} against {told[0].label}: they drove by other terms, "
                f"{terms}. What differs is called neither better nor worse"
            )
        sees = _eyes(one.table)
        saw = _eyes(told[0].table)
        if sees and saw and sees != saw:
            yield (
                f"{told[0].label} sees by {saw}; {one.label} by {sees}: a difference may be the "
                f"camera's"
            )
        if changed := [n for n, v in first.versions.items() if run.spec.setup.versions.get(n) != v]:
            apart = ", ".join(
                f"{n} {first.versions[n]} and {run.spec.setup.versions.get(n)}" for n in changed
            )
            yield (
                f"{told[0].label} and {one.label} ran with other versions, a difference may be "
                f"theirs: {apart}"
            )


def _terms_apart(before: ComparedRun, after: ComparedRun) -> str:
    """The terms by which two runs did not drive alike, with those of each: what their policies were
    told, and when their commands took effect; "" where there are none."""
    one, other = _terms(before.table), _terms(after.table)
    apart = [name for name in one if one[name] != other[name]]
    return "; ".join(
        f"{name} {one[name]} ({before.label}) and {other[name]} ({after.label})" for name in apart
    )


def _eyes(table: pd.DataFrame) -> str:
    """By what a run's policy saw; "" for a blind one."""
    camera, rate_hz = table[["camera", "rate_hz"]].iloc[0]
    return "" if camera == "none" else f"{camera}, at {rate_hz:g} Hz"


def _terms(table: pd.DataFrame) -> dict[str, str]:
    """What makes a run harder or easier, whatever its policy is."""
    first = table.iloc[0]
    return {
        "goal": first["goal_protocol"],
        "odometry": first["odometry"],
        "knowledge": "privileged" if first["privileged"] else "of its own sensors",
        "latency": "real time" if first["real_time"] else f"{first['latency_ms']:g} ms",
    }


def _lonely(pairs: Sequence[tuple[ComparedRun, ComparedRun]]) -> Iterator[str]:
    """Episodes that no pair has."""
    for before, after in pairs:
        mine, theirs = ({*run.table["scenario"]} for run in (before, after))
        if mine != theirs:
            alone = f"{len(mine - theirs)} of {before.label}, {len(theirs - mine)} of {after.label}"
            yield f"scenarios that only one of both runs has are left out: {alone}"
