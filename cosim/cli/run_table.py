"""Print the tables of runs and episodes, and the next commands to use."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from rich.console import Console

from cosim.cli import tables
from cosim.core.units import milliseconds
from cosim.results.discerned import (
    DISCERNED,
    DISCERNED_IN_WORDS,
    episode_pairs,
    has_decoys,
    is_decoy,
    with_discerned,
)
from cosim.results.intervals import MIN_N, Estimate
from cosim.results.log import holds_waypoints
from cosim.results.metrics import (
    COUNTERFACTUAL,
    RATED_EXTRA_M,
    RATED_PER_PROGRESS,
    SUCCESS_IN_WORDS,
)
from cosim.results.run_folder import read_spec
from cosim.results.run_setup import appearance_of
from cosim.results.table import (
    INJECTED,
    crashed_in,
    estimate_of,
    injections_in_words,
    invalid_in,
    policy_in_words,
    why_inconclusive,
)
from cosim.spec.scenario import Scenario, read_suite
from cosim.spec.weather import CLEAR


def print_next_commands(err: Console, folder: Path, table: pd.DataFrame) -> None:
    """Print the commands for a film, a report and a picture of one episode.

    table: a row per episode. The film shows a failure if there is one. Without an ended episode
    only the report is offered.
    """
    run = shlex.quote(str(folder))
    ended = table[table["ended"].notna()]
    lines = [f"cosim report {run} -o report.html"]
    if len(ended):
        failed = ended[ended["success"] == 0.0]
        first = shlex.quote(str((failed if len(failed) else ended)["scenario"].iloc[0]))
        shown = "--failure" if len(failed) else first
        lines = [
            f"cosim film {run} {shown} -o film.mp4",
            *lines,
            f"cosim show {run} --episode {first}",
        ]
    err.print("\n  ".join(["Next:", *lines]), soft_wrap=True, highlight=False, markup=False)


SHOWN = (
    ("success", "SR"),
    ("route_completion", "RC"),
    ("failures_per_100m", "FC"),
    ("collisions_per_100m", "C"),
    ("out_of_lane_per_100m", "OL"),
    ("freezings_per_100m", "F"),
    ("falls_per_100m", "FL"),
    ("velocity_mean_mps", "V"),
)
LETTERS = {
    "SR": SUCCESS_IN_WORDS,
    "D": DISCERNED_IN_WORDS,
    "RC": "share of the route done",
    "FC": "failures per 100 m travelled",
    "C": "collisions per 100 m travelled",
    "OL": "out of lane per 100 m travelled",
    "F": "freezings per 100 m travelled",
    "FL": "falls per 100 m travelled, of robots with legs",
    "V": "mean speed",
}
"""Meaning of each letter, the same in every table; `D` only where there are decoys."""
UNITS = {"FC": "/100m", "C": "/100m", "OL": "/100m", "F": "/100m", "FL": "/100m", "V": "m/s"}
COUNTS = (
    ("collisions", "collisions"),
    ("out_of_lane", "out of lane"),
    ("freezings", "freezings"),
    ("falls", "falls"),
)
MEANS = (*SHOWN[:3], ("failures_per_100m_route", ""), *SHOWN[3:], ("spl", "SPL"))
"""Metrics in the table of means of a run, with their letters."""
WITHOUT_PEOPLE = (
    ("spl", "SPL"),
    ("route_completion", "RC"),
    ("other_collision", "hit\nelse"),
    ("left_lane", "left\nlane"),
)
WITH_PEOPLE = (
    ("spl", "SPL"),
    ("pedestrian_collision", "hit a\nperson"),
    ("other_collision", "hit\nelse"),
    ("left_lane", "left\nlane"),
    ("broke_rule", "broke\nrule"),
    ("pedestrian_distance_min_m", "near-\nest m"),
    ("pedestrian_distance_min_success_m", "of\nwins"),
)
"""Metrics in the table by kind of scenario, with their heads."""
_MEAN_HEADS = ("", "95 % interval", "n")
"""Heads of the columns of a mean."""


def print_table(
    out: Console, table: pd.DataFrame, scheduled: int, folder: Path | None = None
) -> None:
    """Print the table of a run: a row per episode, then means with their intervals.

    table: a row per episode.
    scheduled: number of episodes of the run.
    folder: of the run, to look for waypoints in its trajectories and for its robots.
    """
    heads = (*(f"{head}\n{UNITS.get(head, '')}" for _, head in SHOWN), "counts")
    rows = []
    for _, row in table.iterrows():
        counts = "/".join("-" if pd.isna(row[name]) else f"{row[name]:.0f}" for name, _ in COUNTS)
        ended = row["ended"] if row["status"] == "done" else row["status"]
        name = row["scenario"] + "*" * bool(row.get("nonstandard")) + "+" * bool(row.get(INJECTED))
        rows.append((name, ended, *(value_in_words(row[name]) for name, _ in SHOWN), counts))
    columns = [*tables.names("episode"), *tables.labels("ended"), *tables.figures(*heads)]
    tables.show(out, columns, rows)
    print_terms(out, table, folder)
    if words := _robots_in_words(folder):
        out.print(words, highlight=False, markup=False)
    counted = "/".join(name for _, name in COUNTS)
    shown = [letter for letter in LETTERS if letter != "D" or has_decoys(table)]
    out.print("; ".join(f"{letter} {LETTERS[letter]}" for letter in shown) + f"; counts: {counted}")
    print_means(out, table)
    print_delays(out, table)
    print_statuses(out, table, scheduled)


def _robots_in_words(folder: Path | None) -> str:
    """Return robots and gait of a run; "" for the defaults, and without a run's folder."""
    if folder is None or not (folder / "run.json").is_file():
        return ""
    return read_spec(folder).robots_in_words


def print_means(out: Console, table: pd.DataFrame) -> None:
    """Print the means over all episodes of a run."""
    if not len(table):
        return
    means = with_discerned(dict(MEANS), has_decoys(table))
    rows = [
        (f"{name} ({head})" if head else name, *_mean_cells(estimate_of(table, name)))
        for name, head in means.items()
    ]
    over = "over all but decoys" if has_decoys(table) else "over all episodes"
    tables.show(out, [*tables.names(over), *tables.figures(*_MEAN_HEADS)], rows)
    crashed = crashed_in(table)
    failed = f"; no rates: {crashed} crashed, which counts as SR, RC, SPL and V of 0"
    out.print(
        f"rates are pooled: all failures on all metres, of an episode at most "
        f"{RATED_PER_PROGRESS:g} x its progress + {RATED_EXTRA_M:g} m{failed if crashed else ''}; "
        f"below {MIN_N} episodes only counts"
    )
    if has_decoys(table):
        out.print(f"decoys count in D alone, over {episode_pairs(table).in_words}", highlight=False)
    print_by_split(out, table)


def _mean_cells(estimate: Estimate) -> tuple[str, str, str]:
    """Return mean, interval and number of episodes as text."""
    return estimate.in_words, estimate.interval_in_words(), f"{estimate.n}"


def print_statuses(out: Console, table: pd.DataFrame, scheduled: int) -> None:
    """Print the number of episodes of each status, the reasons, and whether to quote the run."""
    parts = {status: table[table["status"] == status] for status in ("done", "crashed", "invalid")}
    scored = len(parts["done"]) + len(parts["crashed"])
    counts = f"scheduled {scheduled}, scored {scored}, of these crashed {len(parts['crashed'])}"
    decoys = f"; of all rows {is_decoy(table).sum()} are decoys" if has_decoys(table) else ""
    out.print(f"{counts}; invalid {len(parts['invalid'])}{decoys}")
    unsolved = parts["done"][parts["done"]["reason"].fillna("") != ""]
    for _, row in pd.concat([parts["crashed"], parts["invalid"], unsolved]).iterrows():
        status = "not solved" if row["status"] == "done" else row["status"]
        out.print(
            f"{status} {row['scenario']}: {row['reason']}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    if reason := why_inconclusive(table, scheduled):
        out.print(f"not to be quoted: {reason}", soft_wrap=True, highlight=False)


def print_terms(out: Console, table: pd.DataFrame, folder: Path | None = None) -> None:
    """Print the terms of a run: policy, camera, goal, odometry, host, waypoint rule and seed.

    Nonstandard terms, injections and latency follow. A policy without a camera, or a folder
    without waypoints, has no such term.
    """
    named = [
        "policy",
        "track",
        "camera",
        "lidar",
        "imu",
        "people",
        "rate_hz",
        "goal_protocol",
        "odometry",
        "privileged",
        "waypoints",
        "run_seed",
        "nonstandard",
        "policy_runs",
    ]
    if not {*named} <= set(table.columns):
        return
    follows = folder is None or any(map(holds_waypoints, folder.glob("episodes/*/trajectory.npz")))
    for (
        policy,
        track,
        camera,
        lidar,
        imu,
        people,
        rate_hz,
        goal,
        odometry,
        knows,
        waypoints,
        seed,
        odd,
        runs,
    ) in table[named].drop_duplicates().itertuples(index=False):
        terms = [
            f"policy {policy_in_words(policy, knows)}",
            f"sensor track {track}",
            f"at {rate_hz:g} Hz" if camera == "none" else f"camera {camera}, at {rate_hz:g} Hz",
            *([f"lidar {lidar}"] if lidar != "none" else []),
            *([f"imu {imu}"] if imu != "none" else []),
            *([f"people {people}"] if people != "none" else []),
            f"goal {goal}",
            f"odometry {odometry}",
            *([f"policy {runs}"] if runs != "in-process" else []),
            *([waypoints] if follows else []),
            f"seed {seed}",
        ]
        out.print("; ".join(terms), highlight=False, markup=False)
        if odd:
            out.print(f"* nonstandard, not to be compared: {odd}", highlight=False, markup=False)
    renderers = table["renderer"].dropna().astype(str) if "renderer" in table else ()
    if any(appearance_of(renderer) == "mesh" for renderer in renderers):
        out.print("scanned places are drawn by their mesh", highlight=False, markup=False)
    if "weather" in table and (weathers := sorted({*table["weather"]} - {CLEAR})):
        out.print(f"weather {', '.join(weathers)}", highlight=False, markup=False)
    if words := injections_in_words(table):
        out.print(f"+ {words}", soft_wrap=True, highlight=False, markup=False)
    if words := _latency_in_words(table):
        out.print(words, highlight=False, markup=False)


def _latency_in_words(table: pd.DataFrame) -> str:
    """Return the latency of commands in words; "" without latency."""
    if "latency_ms" not in table or not (table["latency_ms"].any() or table["real_time"].any()):
        return ""
    measured = table["real_time"].any()
    late_ms = table.loc[table["ended"].notna(), "latency_ms"] if measured else table["latency_ms"]
    if not len(late_ms):
        return "in real time: no episode came to its end, so no latency was measured"
    if not measured:
        return (
            f"latency {late_ms.median():g} ms: commands take effect so much later than what they "
            f"answer"
        )
    words = (
        f"commands took effect {_median_and_range(late_ms)} after what they answer, at whole "
        f"ticks of 50 ms"
    )
    if len(took_ms := table["answer_ms"].dropna()):
        words = f"the median answer took {_median_and_range(took_ms)}; {words}"
    return (
        f"in real time: {words}; as measured here, not to be had again from the seed, only replayed"
    )


def _median_and_range(of_episodes_ms: pd.Series[float]) -> str:
    least, middle, most = (milliseconds(float(of_episodes_ms.quantile(q))) for q in (0.0, 0.5, 1.0))
    return f"{middle} ({least.removesuffix(' ms')} to {most})"


def print_delays(out: Console, table: pd.DataFrame) -> None:
    """Print the delays caused by the robot, per episode; nothing without `--counterfactual`."""
    if not set(COUNTERFACTUAL) <= set(table.columns):
        return
    rows = [(name, *_mean_cells(estimate_of(table, name))) for name in COUNTERFACTUAL]
    first = tables.names("against the same street without the robot")
    tables.show(out, [*first, *tables.figures("per episode", *_MEAN_HEADS[1:])], rows)


def value_in_words(value: float | None) -> str:
    """Return a number with two decimals, or "-" for None and NaN."""
    return "-" if value is None or pd.isna(value) else f"{value:.2f}"


def kinds_of(folder: Path) -> Mapping[str, str]:
    """Return each scenario's structure, or the kind of its single event, or ""."""
    scenarios = read_suite(folder / "scenarios.json").scenarios
    return {
        s.id: s.structure or (s.events[0].kind if has_single_event(s) else "") for s in scenarios
    }


def has_single_event(scenario: Scenario) -> bool:
    """Return whether a scenario tests its single event."""
    return scenario.ends_on_failure and len(scenario.events) == 1


def print_by_kind(out: Console, table: pd.DataFrame, kinds: Mapping[str, str]) -> None:
    """Print a row of means per kind of scenario; nothing for fewer than two kinds.

    A column counts crashed episodes if there are any.
    """
    named = [kind for kind in dict.fromkeys(kinds.values()) if kind]
    if len(named) < 2:
        return
    people = bool(table["pedestrian_distance_min_m"].notna().any())
    columns = WITH_PEOPLE if people else WITHOUT_PEOPLE
    d_heads = ("D", "95 % of D", "pairs") if has_decoys(table) else ()
    crashed = ["crash"] if crashed_in(table) else []
    shown = ("n", *crashed, "SR", "95 % of SR", *d_heads)
    heads = (*shown, *(head for _, head in columns), "in-\nvalid")
    rows = []
    for kind in named:
        part = table[table["scenario"].map(kinds) == kind]
        success, *rest = (
            estimate_of(part, name) for name in ("success", *(name for name, _ in columns))
        )
        counts = f"{success.n}", *([f"{crashed_in(part)}"] if crashed else [])
        of_d = _d_cells(part) if d_heads else ()
        shares = (success.in_words, success.interval_in_words(".."), *of_d)
        means = (estimate.in_words for estimate in rest)
        rows.append((kind, *counts, *shares, *means, f"{invalid_in(part)}"))
    tables.show(out, [*tables.names(""), *tables.figures(*heads)], rows)
    unknown = "; - unknown, because an episode crashed" if crashed else ""
    out.print(
        "n episodes that are scored; hit a person, hit else, left lane, broke rule: share of "
        "these; nearest: least distance to a person's centre, mean over episodes, of wins: over "
        f"those that succeeded; SPL success by path length{unknown}"
        if people
        else "n episodes that are scored; hit else, left lane: share of these; SPL success "
        f"weighted by path length{unknown}"
    )


def _d_cells(part: pd.DataFrame) -> tuple[str, str, str]:
    """Return D, its interval and the number of pairs, as text."""
    estimate = estimate_of(part, DISCERNED)
    return estimate.in_words, estimate.interval_in_words(".."), f"{estimate.n}"


def print_by_split(out: Console, table: pd.DataFrame) -> None:
    """Print means of `val` and `test` separately if a run has both."""
    if "split" not in table or table["split"].nunique() < 2:
        return
    shown = {"success": "SR", "route_completion": "RC", "failures_per_100m": "FC /100m"}
    columns = with_discerned(shown, has_decoys(table))
    rows = []
    for split, part in table.groupby("split", sort=False):
        means = [estimate_of(part, name) for name in columns]
        cells = (
            f"{one.in_words} {one.interval_in_words('..')}" if one.has_interval else one.in_words
            for one in means
        )
        crashed = f"{crashed_in(part)}"
        rows.append((str(split), f"{means[0].n}", crashed, *cells))
    heads = ("n", "crashed", *(f"{head}, 95 %" for head in columns.values()))
    tables.show(out, [*tables.names("split"), *tables.figures(*heads)], rows)
