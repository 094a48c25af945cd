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
from cosim.results.discerned import (
    DISCERNED,
    episode_pairs,
    has_decoys,
    is_decoy,
    with_discerned,
    without_decoys,
)
from cosim.results.intervals import BOOTSTRAP, CONFIDENCE, MIN_N, RATE_PER_M, counts_in_words
from cosim.results.metrics import (
    COUNTERFACTUAL,
    METRICS,
    POOLED,
    RATE_NEEDS_M,
    UNKNOWN_WITH_CRASH,
)
from cosim.results.run_spec import names_by_conditions
from cosim.results.table import (
    crashed_in,
    injections_in_words,
    numeric_column,
    table_of,
    why_inconclusive,
)
from cosim.results.verified_run import VerifiedRun, read_verified_run
from cosim.spec.scenario import Scenario

MIN_CHANGED: Final = 6
"""Minimum number of changed pairs for a verdict."""
_TRACK: Final = "sensor track"
PairedVerdict = Literal["within noise", "too few", "better", "worse", "differs", ""]


class PairedDifference(NamedTuple):
    """Difference of a metric between two runs, paired by scenario.

    before, after: means over the pairs in which both runs have a value; NaN without such pairs
    low, high: bounds of the interval of after - before; NaN below MIN_N pairs
    n: number of these pairs
    changed: number of pairs whose values differ; for a rate, only pairs with at least one count
    """

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
        """Return the verdict in words; "" below MIN_N pairs.

        higher_is_better: None if neither direction is better
        """
        if self.n < MIN_N:
            return ""
        if self.low <= 0.0 <= self.high:
            return "within noise"
        if self.changed < MIN_CHANGED:
            return "too few"
        if higher_is_better is None:
            return "differs"
        return "better" if (self.low > 0.0) == higher_is_better else "worse"


_NO_PAIRS: Final = PairedDifference(math.nan, math.nan, math.nan, math.nan, 0, 0)


def difference_of_means(before: Floats, after: Floats) -> PairedDifference:
    """Return the difference of means over (N,) paired values; pairs with a NaN are skipped."""
    both = ~(np.isnan(before) | np.isnan(after))
    before, after = before[both], after[both]
    n = len(before)
    changes = after - before
    if not n:
        return _NO_PAIRS
    low, high = _interval(changes[_draws(n)].sum(axis=1) / n if changes.any() else changes, n)
    return PairedDifference(
        float(before.mean()), float(after.mean()), low, high, n, int(np.count_nonzero(changes))
    )


def difference_of_rates(
    before: tuple[Floats, Floats], after: tuple[Floats, Floats]
) -> PairedDifference:
    """Return the difference of pooled rates per 100 m.

    before, after: counts (N,) and metres (N,) of the same N scenarios

    A bootstrap sample draws the same scenarios for both runs and divides all counts by all metres.
    """
    columns = np.array([*before, *after])
    columns = columns[:, ~np.isnan(columns).any(axis=0)]
    n = columns.shape[1]
    if not n or min(columns[1].sum(), columns[3].sum()) < RATE_NEEDS_M:
        return _NO_PAIRS
    counted, metres, counted_after, metres_after = columns
    rates = (
        RATE_PER_M * counted.sum() / metres.sum(),
        RATE_PER_M * counted_after.sum() / metres_after.sum(),
    )
    differs = (counted != counted_after) | (metres != metres_after)
    changed = int((differs & ((counted > 0.0) | (counted_after > 0.0))).sum())
    if not differs.any() or not (counted.any() or counted_after.any()):
        return PairedDifference(*rates, *_interval(np.zeros(n), n), n, 0)
    drawn = [column[_draws(n)].sum(axis=1) for column in columns]
    moved = (drawn[1] > 0.0) & (drawn[3] > 0.0)
    counted, metres, counted_after, metres_after = (column[moved] for column in drawn)
    low, high = _interval(RATE_PER_M * (counted_after / metres_after - counted / metres), n)
    return PairedDifference(*rates, low, high, n, changed)


def _interval(differences: Floats, n: int) -> tuple[float, float]:
    """Return the interval of differences drawn from n pairs; NaN below MIN_N pairs."""
    if n < MIN_N or not len(differences):
        return math.nan, math.nan
    # Expanded percentile interval: the plain one is too narrow for small n.
    t = stdtrit(n - 1, 0.5 + CONFIDENCE / 2)
    tail = float(ndtr(-t * math.sqrt(n / (n - 1))))
    low, high = np.quantile(differences, [tail, 1.0 - tail])
    return float(low), float(high)


@lru_cache(maxsize=8)
def _draws(n: int) -> NDArray[np.int64]:
    """Return the (BOOTSTRAP, n) indices of the pairs in each bootstrap sample."""
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
    "counts_before",
    "counts_after",
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
    "decoy",
    "flip",
    "ended_before",
    "ended_after",
)

Groups = Mapping[tuple[str, str], frozenset[str]]
"""Scenario ids by group: key ("suite" | "event" | "structure" | "split", name)."""


class ComparedRun(NamedTuple):
    """One run of a comparison.

    label: name in tables
    table: one row per episode, as in results.csv
    """

    label: str
    path: Path
    table: pd.DataFrame


class RunComparison(NamedTuple):
    """Result of comparing runs.

    before: the run that the others are compared with
    differences, flipped: tables with the columns `DIFFERENCES` and `FLIPPED`
    notes: warnings for the reader
    """

    suite: str
    before: ComparedRun
    others: tuple[ComparedRun, ...]
    differences: pd.DataFrame
    flipped: pd.DataFrame
    notes: tuple[str, ...]


def compare_runs(paths: Sequence[Path]) -> RunComparison:
    """Compare the first run with each of the others.

    Raises UsageError for fewer than two runs, RunError for runs of different suites or without a
    common scenario, and what `read_verified_run` raises.
    """
    if len(paths) < 2:
        raise UsageError("a comparison needs two runs or more: cosim compare RUN OTHER ...")
    runs = [read_verified_run(path) for path in paths]
    for run in runs:
        _check_suites(runs[0], run)
    before, *others = (
        ComparedRun(label, run.path, table_of(run.records.values()))
        for label, run in zip(_labels(runs), runs, strict=True)
    )
    groups = groups_of(runs[0].spec.suite, runs[0].scenarios.values())
    pairs = [(before, other) for other in others]
    compared = [differences_of(*pair, groups, judged=not _differing_terms(*pair)) for pair in pairs]
    differences = pd.concat(compared, ignore_index=True)
    flipped = pd.concat([flipped_between(*pair) for pair in pairs], ignore_index=True)
    notes = (*_notes(runs, [before, *others]), *_unpaired_notes(pairs))
    return RunComparison(runs[0].spec.suite, before, tuple(others), differences, flipped, notes)


def groups_of(suite: str, scenarios: Iterable[Scenario]) -> dict[tuple[str, str], frozenset[str]]:
    """Return the groups of a suite: all, then by event, structure and split, without duplicates."""
    members: dict[tuple[str, str], set[str]] = {}
    for scenario in scenarios:
        kinds = dict.fromkeys(event.kind for event in scenario.events)
        named = [("suite", suite), *(("event", kind) for kind in kinds)]
        for key in [*named, ("structure", scenario.structure), ("split", scenario.split)]:
            members.setdefault(key, set()).add(scenario.id)
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
    """Return one row (`DIFFERENCES`) for each group and metric, over the scenarios that both runs
    have.

    names: metrics; all that both runs have if empty
    judged: False to report "differs" instead of better or worse

    Decoys count in `discerned` alone, which is paired by event and decoy.
    """
    table_before, table_after = (run.table.set_index("scenario") for run in (before, after))
    ids = [name for name in table_before.index if name in table_after.index]
    names = names or _common_metrics(table_before, table_after)
    rows = []
    for (by, group), members in groups.items():
        inside = [name for name in ids if name in members]
        if not inside:
            continue
        rows_of = table_before.loc[inside], table_after.loc[inside]
        events_of = without_decoys(rows_of[0]), without_decoys(rows_of[1])
        for name in names:
            pair = rows_of if name == DISCERNED else events_of
            paired = _difference(name, *pair)
            unit, better = _unit_and_direction(name)
            verdict = paired.verdict(better if judged else None)
            key = (before.label, after.label, by, group, name, unit)
            counts = _counts(name, *pair) if paired.n else ("", "")
            means = (paired.before, paired.after, *counts, paired.difference)
            interval = (paired.low, paired.high)
            rows.append((*key, paired.n, *means, *interval, paired.changed, verdict))
    return pd.DataFrame(rows, columns=list(DIFFERENCES))


def _common_metrics(before: pd.DataFrame, after: pd.DataFrame) -> list[str]:
    """Return the metrics of both tables, `discerned` only if both have decoys."""
    common = {
        name: ""
        for name in (*METRICS, *COUNTERFACTUAL)
        if name in before.columns and name in after.columns
    }
    return [*with_discerned(common, has_decoys(before) and has_decoys(after))]


def _unit_and_direction(name: str) -> tuple[str, bool | None]:
    """Return the unit of a metric, and whether higher is better; None if neither is."""
    if name == DISCERNED:
        return "", True
    return METRICS[name][:2] if name in METRICS else (COUNTERFACTUAL[name], None)


def _difference(name: str, before: pd.DataFrame, after: pd.DataFrame) -> PairedDifference:
    """Return the paired difference of a metric, without pairs if a crash leaves it unknown."""
    if name in UNKNOWN_WITH_CRASH and (crashed_in(before) or crashed_in(after)):
        return _NO_PAIRS
    if name not in POOLED:
        return difference_of_means(*_paired_columns(name, before, after))
    counted, metres, counted_after, metres_after = _paired_columns(name, before, after)
    return difference_of_rates((counted, metres), (counted_after, metres_after))


def _paired_columns(name: str, before: pd.DataFrame, after: pd.DataFrame) -> list[Floats]:
    """Return the values (N,) of a metric in both tables; of a rate counts and metres of each.

    N counts rows, or for `discerned` pairs of an event and its decoy.
    """
    tables = before, after
    if name == DISCERNED:
        solved = [episode_pairs(table.reset_index()).solved for table in tables]
        both = solved[0].index.intersection(solved[1].index)
        return [np.asarray(pairs[both], dtype=float) for pairs in solved]
    columns = POOLED.get(name, (name,))
    return [numeric_column(table, column) for table in tables for column in columns]


def _counts(name: str, before: pd.DataFrame, after: pd.DataFrame) -> tuple[str, str]:
    """Return the counts of a share or rate in each run, over pairs in which both have a value.

    "" for other means, and without such a pair.
    """
    values = np.array(_paired_columns(name, before, after))
    values = values[:, ~np.isnan(values).any(axis=0)]
    n = values.shape[1]
    is_share = name == DISCERNED or (name in METRICS and METRICS[name].share)
    if not n or not (name in POOLED or is_share):
        return "", ""
    sums = values.sum(axis=1).reshape(2, -1)
    one, other = (counts_in_words(counted, n, *metres) for counted, *metres in sums.tolist())
    return one, other


def flipped_between(before: ComparedRun, after: ComparedRun) -> pd.DataFrame:
    """Return one row (`FLIPPED`) for each scenario solved by exactly one of two runs.

    The flip is "won" if the second run solved it, else "lost".
    """
    table_before, table_after = (
        run.table.assign(decoy=is_decoy(run.table)).set_index("scenario") for run in (before, after)
    )
    rows = []
    for name in table_before.index.intersection(table_after.index):
        row_before, row_after = table_before.loc[name], table_after.loc[name]
        if (
            pd.notna(row_before["success"])
            and pd.notna(row_after["success"])
            and row_before["success"] != row_after["success"]
        ):
            flip = "won" if row_after["success"] > row_before["success"] else "lost"
            ends = (
                str(row["ended"] if row["status"] == "done" else row["status"])
                for row in (row_before, row_after)
            )
            rows.append(
                (
                    before.label,
                    after.label,
                    name,
                    row_before["split"],
                    row_before["structure"],
                    bool(row_before["decoy"]),
                    flip,
                    *ends,
                )
            )
    return pd.DataFrame(rows, columns=list(FLIPPED))


def _check_suites(one: VerifiedRun, other: VerifiedRun) -> None:
    """Raise RunError if two runs have different suites or no common scenario."""
    spec, other_spec = one.spec, other.spec
    suite_hash, other_hash = spec.setup.suite_hash, other_spec.setup.suite_hash
    if suite_hash != other_hash:
        what = (
            "the same suite"
            if spec.suite != other_spec.suite
            else "the same version of it (former suite, edited, --crowd?)"
        )
        raise RunError(
            f"{other.path} is of suite '{other_spec.suite}' {other_spec.suite_version} "
            f"({other_hash}), "
            f"{one.path} of '{spec.suite}' {spec.suite_version} ({suite_hash}): run both on {what}"
        )
    if not one.records.keys() & other.records.keys():
        raise RunError(
            f"{other.path} has no scenario that {one.path} has: run both with the same "
            f"--scenario, --episodes"
        )


def _labels(runs: Sequence[VerifiedRun]) -> list[str]:
    """Return unique labels: policy names, with robots and weather if there are several.

    Folder names where these do not differ, numbered if equal.
    """
    names = names_by_conditions([run.spec for run in runs])
    if len({*names}) < len(names):
        names = [run.path.absolute().name for run in runs]
    return [
        f"{name} ({names[:i].count(name) + 1})" if name in names[:i] else name
        for i, name in enumerate(names)
    ]


def _notes(runs: Sequence[VerifiedRun], compared: Sequence[ComparedRun]) -> Iterator[str]:
    """Yield warnings: why a run is inconclusive, and what differs besides the policy."""
    first = runs[0].spec.setup
    first_label = compared[0].label
    first_camera = _camera_in_words(compared[0].table)
    for run, other in zip(runs, compared, strict=True):
        if reason := why_inconclusive(other.table, len(run.spec.scenarios)):
            yield f"{other.label} is not to be quoted: {reason}"
        if nonstandard := next(
            (record.nonstandard for record in run.records.values() if record.nonstandard), ""
        ):
            yield f"{other.label} is nonstandard: {nonstandard}"
        pairs = episode_pairs(other.table)
        if pairs.invalid or pairs.single:
            yield f"{other.label}: D is over {pairs.in_words}"
        if words := run.spec.conditions_in_words:
            yield f"{other.label}: {words}"
        if words := injections_in_words(other.table):
            yield f"{other.label}: {words}"
        if crashed := crashed_in(other.table):
            yield (
                f"{other.label}: {crashed} crashed, counted as failed, with SR, RC, SPL and V of "
                f"0; groups with them have neither rates nor other means"
            )
        if terms := _differing_terms(compared[0], other):
            yield (
                f"No verdict of {other.label} against {first_label}: they drove by other "
                f"terms, {terms}. What differs is called neither better nor worse"
            )
        camera = _camera_in_words(other.table)
        if camera and first_camera and camera != first_camera:
            yield (
                f"{first_label} sees by {first_camera}; {other.label} by {camera}: "
                "a difference may be the camera's"
            )
        drawn, drawn_first = run.spec.setup.renderer, first.renderer
        if camera and first_camera and drawn != drawn_first:
            yield (
                f"{first_label}'s pictures are drawn by {drawn_first}, {other.label}'s by {drawn}: "
                "a small difference may be the renderer's"
            )
        if words := _looks_apart(runs[0], run):
            yield (
                f"{first_label} and {other.label} saw scanned places differently, a difference may "
                f"be the look's (--appearance, or another import): {words}"
            )
        if changed := [n for n, v in first.versions.items() if run.spec.setup.versions.get(n) != v]:
            differing = ", ".join(
                f"{n} {first.versions[n]} and {run.spec.setup.versions.get(n)}" for n in changed
            )
            yield (
                f"{first_label} and {other.label} ran with other versions, a difference may be "
                f"theirs: {differing}"
            )


def _looks_apart(one: VerifiedRun, other: VerifiedRun) -> str:
    """Return in words how the first scanned place that looked different did; "" if none did."""
    for name, record in one.records.items():
        looks = record.scan, other.records[name].scan if name in other.records else None
        if looks[0] is not None and looks[1] is not None and looks[0] != looks[1]:
            return f"in {name}, {looks[0].in_words} and {looks[1].in_words}"
    return ""


def _differing_terms(before: ComparedRun, after: ComparedRun) -> str:
    """Return in words the terms that differ between two runs; "" if none do.

    A blind policy is a baseline of every sensor track but the privileged one.
    """
    one, other = _terms(before.table), _terms(after.table)
    apart = [name for name in one if one[name] != other[name]]
    tracks = {terms[_TRACK] for terms in (one, other)}
    if "blind" in tracks and "privileged" not in tracks:
        apart = [name for name in apart if name != _TRACK]
    return "; ".join(
        f"{name} {one[name]} ({before.label}) and {other[name]} ({after.label})" for name in apart
    )


def _camera_in_words(table: pd.DataFrame) -> str:
    """Return camera and rate of a run's policy in words; "" without a camera."""
    camera, rate_hz = table[["camera", "rate_hz"]].iloc[0]
    return "" if camera == "none" else f"{camera}, at {rate_hz:g} Hz"


def _terms(table: pd.DataFrame) -> dict[str, str]:
    """Return the settings that affect how hard a run is, independent of the policy."""
    first = table.iloc[0]
    return {
        "robot": " and ".join(sorted({*table["robot"]})),
        "weather": " and ".join(sorted({*table["weather"]})),
        "goal": first["goal_protocol"],
        "odometry": first["odometry"],
        _TRACK: first["track"],
        "latency": "real time" if first["real_time"] else f"{first['latency_ms']:g} ms",
    }


def _unpaired_notes(pairs: Sequence[tuple[ComparedRun, ComparedRun]]) -> Iterator[str]:
    """Yield a note for each pair of runs that do not have the same scenarios."""
    for before, after in pairs:
        before_ids, after_ids = ({*run.table["scenario"]} for run in (before, after))
        if before_ids != after_ids:
            only_before, only_after = len(before_ids - after_ids), len(after_ids - before_ids)
            yield (
                "scenarios that only one of both runs has are left out: "
                f"{only_before} of {before.label}, {only_after} of {after.label}"
            )
