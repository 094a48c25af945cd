"""Tables of the command line: of a run, of its kinds of events, of one episode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from cosim.core.clock import Clock
from cosim.judge.metrics import COUNTERFACTUAL, METRICS
from cosim.records.record import Record
from cosim.records.results import not_to_be_quoted, summary_of
from cosim.spec.scenario import Scenario, Suite, read_suite

SHOWN = (
    ("success", "SR"),
    ("route_completion", "RC"),
    ("failures_per_100m", "FC"),
    ("collisions_per_100m", "C"),
    ("out_of_lane_per_100m", "OL"),
    ("freezings_per_100m", "F"),
    ("velocity_mean_mps", "V"),
)
LETTERS = {
    "SR": "success: the goal reached in time without a failure",
    "RC": "share of the route done",
    "FC": "failures per 100 m travelled",
    "C": "collisions per 100 m travelled",
    "OL": "out of lane per 100 m travelled",
    "F": "freezings per 100 m travelled",
    "V": "mean speed",
}
"""What a letter means, in every table: what is counted otherwise has no letter."""
UNITS = {"FC": "/100m", "C": "/100m", "OL": "/100m", "F": "/100m", "V": "m/s"}
COUNTS = (("collisions", "collisions"), ("out_of_lane", "out of lane"), ("freezings", "freezings"))
MEANS = (*SHOWN[:3], ("failures_per_100m_route", ""), *SHOWN[3:], ("spl", "SPL"))
"""Those of a run."""
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
"""Means over the episodes of a kind: shares of them, and metres."""


def print_table(out: Console, table: pd.DataFrame, scheduled: int) -> None:
    """The table of a run: a row per episode, then the means with their intervals. Made for 80 columns."""
    heads = (*(f"{head}\n{UNITS.get(head, '')}" for _, head in SHOWN), "counts")
    numbers = (Column(head, no_wrap=True, justify="right") for head in heads)
    shown = Table(
        Column("episode", no_wrap=True), Column("ended", no_wrap=True), *numbers, box=box.SIMPLE_HEAD, padding=0
    )
    for _, row in table.iterrows():
        counts = "/".join("-" if pd.isna(row[name]) else f"{row[name]:.0f}" for name, _ in COUNTS)
        ended = row["ended"] if row["status"] == "done" else row["status"]
        shown.add_row(
            row["scenario"] + "*" * bool(row.get("nonstandard")),
            ended,
            *(_cell(row[name]) for name, _ in SHOWN),
            counts,
        )
    out.print(shown)
    print_terms(out, table)
    counted = "/".join(name for _, name in COUNTS)
    out.print("; ".join(f"{letter} {meaning}" for letter, meaning in LETTERS.items()) + f"; counts: {counted}")
    print_means(out, table)
    print_delays(out, table)
    print_statuses(out, table, scheduled)


def print_means(out: Console, table: pd.DataFrame) -> None:
    """What came out of all episodes of a run together."""
    if not len(table):
        return
    means = Table("over all episodes", "", "95 % interval", "n", box=box.SIMPLE_HEAD)
    for (name, head), (_, row) in zip(MEANS, summary_of(table, [n for n, _ in MEANS]).iterrows(), strict=True):
        means.add_row(f"{name} ({head})" if head else name, *_mean_cells(row))
    out.print(means)
    crashed = int((table["status"] == "crashed").sum())
    missing = f"; none, because {crashed} crashed" if crashed else ""
    out.print(f"rates are pooled: all failures on all metres{missing}; what crashed counts as the worst elsewhere")
    print_by_split(out, table)


def _mean_cells(row: pd.Series[float]) -> tuple[str, str, str]:
    """Mean, interval and number of episodes, from a row of `summary_of`."""
    interval = f"{_cell(row['low'])} to {_cell(row['high'])}" if row["n"] else "-"
    return _cell(row["mean"]), interval, f"{row['n']:.0f}"


def print_statuses(out: Console, table: pd.DataFrame, scheduled: int) -> None:
    """How many episodes there are of each status, why, and whether the run may be quoted."""
    parts = {status: table[table["status"] == status] for status in ("done", "crashed", "invalid")}
    scored = len(parts["done"]) + len(parts["crashed"])
    counts = f"scheduled {scheduled}, scored {scored}, of these crashed {len(parts['crashed'])}"
    out.print(f"{counts}; invalid {len(parts['invalid'])}")
    for _, row in pd.concat([parts["crashed"], parts["invalid"]]).iterrows():
        out.print(f"{row['status']} {row['scenario']}: {row['reason']}", soft_wrap=True, markup=False, highlight=False)
    if reason := not_to_be_quoted(table, scheduled):
        out.print(f"not to be quoted: {reason}", soft_wrap=True, highlight=False)


def print_terms(out: Console, table: pd.DataFrame) -> None:
    """What the policy saw by and was told of where to go, how its waypoints were followed, the run's seed; and what is
    not as the robot has it."""
    named = ["camera", "rate_hz", "goal_protocol", "odometry", "privileged", "waypoints", "run_seed", "nonstandard"]
    if not {*named} <= set(table.columns):
        return
    for camera, rate_hz, goal, odometry, knows, waypoints, seed, odd in (
        table[named].drop_duplicates().itertuples(index=False)
    ):
        told = f"goal {goal}; odometry {odometry}; " + "privileged; " * bool(knows)
        out.print(f"camera {camera}, at {rate_hz:g} Hz; {told}{waypoints}; seed {seed}", highlight=False, markup=False)
        if odd:
            out.print(f"* nonstandard, not to be compared: {odd}", highlight=False, markup=False)
    if words := _latency_in_words(table):
        out.print(words, highlight=False, markup=False)


def _latency_in_words(table: pd.DataFrame) -> str:
    """How late commands took effect, where they did."""
    if "latency_ms" not in table or not (table["latency_ms"].any() or table["real_time"].any()):
        return ""
    measured = table["real_time"].any()
    late_ms = table.loc[table["ended"].notna(), "latency_ms"] if measured else table["latency_ms"]
    if not len(late_ms):
        return "in real time: no episode came to its end, so no latency was measured"
    least, middle, most = (f"{late_ms.quantile(q):g}" for q in (0.0, 0.5, 1.0))
    if not measured:
        return f"latency {middle} ms: commands take effect so much later than what they answer"
    told = f"latency of an episode's answers {middle} ms ({least} to {most} ms)"
    return f"in real time: {told}, as measured here; not to be had again from the seed, only replayed"


def print_names(out: Console) -> None:
    """Suites, robots and their cameras, policies, goals: a line for each."""
    from cosim.policies import POLICIES
    from cosim.spec.goal import GOALS
    from cosim.spec.robot import ROBOTS
    from scenarios.catalog import SUITES, load_suite

    for name in SUITES:
        whole = load_suite(name)
        out.print(f"suite   {name}  {len(whole.scenarios)} scenarios, version {whole.version}, {whole.content_hash}")
    for one in ROBOTS.values():
        size = f"{one.length_m:.2f} x {one.width_m:.2f} m"
        out.print(f"robot   {one.name}  {size}, travels at {one.cruise_mps:g} m/s, turns at {one.w_max_radps:g} rad/s")
        for name, mount in one.mounts.items():
            out.print(f"camera  {one.name} {name}  {mount.in_words}", soft_wrap=True)
    for name, make in POLICIES.items():
        out.print(f"policy  {name}  {(make.__doc__ or '').splitlines()[0]}", soft_wrap=True)
    for name, words in GOALS.items():
        out.print(f"goal    {name}  {words}", soft_wrap=True)


def print_scenarios(out: Console, suite: Suite) -> None:
    """A row per scenario of a suite: made for 80 columns."""
    heads = ("scenario", "place", "route\nm", "cross-\nings", "events", "bar-\nriers", "limit\ns")
    shown = Table(*(Column(head, no_wrap=True) for head in heads), box=box.SIMPLE_HEAD, padding=0)
    for s in suite.scenarios:
        events = s.events[0].kind if len(s.events) == 1 else str(len(s.events))
        numbers = (f"{s.route_line.length_m:.0f}", str(len(s.crossings)), events, str(len(s.barriers)))
        shown.add_row(s.id, escape(s.place.name), *numbers, f"{s.time_limit_s:.0f}")
    out.print(shown)


def print_delays(out: Console, table: pd.DataFrame) -> None:
    """What the robot cost others, per episode, in a run that was asked to compare; nothing in any other."""
    if not set(COUNTERFACTUAL) <= set(table.columns):
        return
    shown = Table("against the same street without the robot", "per episode", "95 % interval", "n", box=box.SIMPLE_HEAD)
    for name, row in summary_of(table, tuple(COUNTERFACTUAL)).iterrows():
        shown.add_row(str(name), *_mean_cells(row))
    out.print(shown)


def print_episode(out: Console, record: Record) -> None:
    """One episode in words: how it ended, every failure, every event, every metric."""
    out.print(f"{record.scenario}: {record.status} {record.ended or ''} {record.reason}", soft_wrap=True, markup=False)
    if record.latency_ms or record.real_time:
        real = ", the median of what was measured: replayed, never made again" if record.real_time else ""
        out.print(f"  commands took effect {record.latency_ms:g} ms after what they answer{real}", soft_wrap=True)
    for failure in record.failures:
        what = f" with {failure.other_kind} {failure.other}" if failure.other else ""
        fault = f", {failure.fault}" if failure.fault else ""
        out.print(f"  {Clock().time_s(failure.tick):7.2f} s  {failure.kind}{what} at {failure.route_s_m:.1f} m{fault}")
    for contact in record.walked_into:
        where = f"at {contact.route_s_m:.1f} m, {contact.fault}"
        out.print(f"  {Clock().time_s(contact.tick):7.2f} s  walked into by {contact.other} {where}")
    for event in record.events:
        at = "never triggered" if event.triggered_at_s is None else f"triggered at {event.triggered_at_s:.2f} s"
        out.print(f"  event {event.id} {event.kind}: {at}")
    table = Table("metric", "value", "unit")
    for name, metric in METRICS.items():
        table.add_row(name, _cell(record.measures.get(name)), metric.unit)
    for name, unit in COUNTERFACTUAL.items():
        if name in record.measures:
            table.add_row(name, _cell(record.measures[name]), unit)
    out.print(table)


def _cell(value: float | None) -> str:
    return "-" if value is None or pd.isna(value) else f"{value:.2f}"


def kinds_of(folder: Path) -> Mapping[str, str]:
    """What each scenario of a run is an example of: its structure, or the kind of its one event; "" for neither."""
    scenarios = read_suite(folder / "scenarios.json").scenarios
    return {s.id: s.structure or (s.events[0].kind if about_one_event(s) else "") for s in scenarios}


def about_one_event(scenario: Scenario) -> bool:
    """Whether a scenario is there for its one event."""
    return scenario.ends_on_failure and len(scenario.events) == 1


def print_by_kind(out: Console, table: pd.DataFrame, kinds: Mapping[str, str]) -> None:
    """A row per kind of scenario: how many episodes, and their means. Nothing for fewer than two kinds."""
    named = [kind for kind in dict.fromkeys(kinds.values()) if kind]
    if len(named) < 2:
        return
    people = bool(table["pedestrian_distance_min_m"].notna().any())
    columns = WITH_PEOPLE if people else WITHOUT_PEOPLE
    heads = ("n", "SR", "95 % of SR", *(head for _, head in columns), "in-\nvalid")
    numbers = (Column(head, no_wrap=True, justify="right") for head in heads)
    shown = Table(Column("", no_wrap=True), *numbers, box=box.SIMPLE_HEAD, padding=0)
    for kind in named:
        part = table[table["scenario"].map(kinds) == kind]
        means = summary_of(part, ("success", *(name for name, _ in columns)))
        low, high, scored = (float(means[column].iloc[0]) for column in ("low", "high", "n"))
        interval = f"{low:.2f}..{high:.2f}" if scored else "-"
        success, *rest = (_cell(mean) for mean in means["mean"])
        invalid = str((part["status"] == "invalid").sum())
        shown.add_row(kind, f"{scored:.0f}", success, interval, *rest, invalid)
    out.print(shown)
    out.print(
        "n episodes that are scored; hit a person, hit else, left lane, broke rule: share of these; nearest: least "
        "distance to a person's centre, mean over episodes, of wins: over those that succeeded; SPL success by path "
        "length"
        if people
        else "n episodes that are scored; hit else, left lane: share of these; SPL success weighted by path length"
    )


def print_by_split(out: Console, table: pd.DataFrame) -> None:
    """The episodes of val and of test apart, where a run has both."""
    if "split" not in table or table["split"].nunique() < 2:
        return
    names = ("success", "route_completion", "failures_per_100m")
    columns = (Column(head, no_wrap=True) for head in ("split", "n", "SR, 95 %", "RC, 95 %", "FC /100m, 95 %"))
    shown = Table(*columns, box=box.SIMPLE_HEAD)
    for split, part in table.groupby("split", sort=False):
        means = summary_of(part, names)
        cells = (f"{_cell(row['mean'])} {_cell(row['low'])}..{_cell(row['high'])}" for _, row in means.iterrows())
        shown.add_row(str(split), f"{means['n'].iloc[0]:.0f}", *cells)
    out.print(shown)


def print_sheet(out: Console, sheet: pd.DataFrame) -> None:
    """What was measured of each event of a run (`scenarios.viewing.eventsheet`), and two summaries by kind: for 80
    columns."""
    from scenarios.viewing.eventsheet import summary

    heads = ("trigger\nm", "error\nm", "tick\nm", "speed\nm/s", "stated\nm/s", "left\nm", "angle\ndeg", "least\nm")
    columns = (Column(head, justify="right", no_wrap=True) for head in heads)
    rows = Table(Column("episode", overflow="fold"), *columns, box=box.SIMPLE_HEAD, padding=0)
    for row in sheet.itertuples(index=False):
        name = row[0] if row[0].startswith(row[1]) else f"{row[0]} {row[1]}"
        numbers = (f"{value:.{digits}f}" for value, digits in zip(row[2:], (2, 3, 3, 2, 2, 2, 0, 2), strict=True))
        rows.add_row(name, *("-" if n == "nan" else n for n in numbers))
    out.print(rows)
    for short in summary(sheet):
        columns = (Column(head, no_wrap=True) for head in short.columns)
        table = Table(*columns, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for row in short.itertuples(index=False):
            table.add_row(*(str(value) for value in row))
        out.print(table)
    out.print(
        "trigger: from the robot to the event's place, when it began; error: off what is stated; tick: what the robot "
        "drove in a tick, the most that the error may be; off: triggers beyond that; speed: of the person while it "
        "walks, stated: of the scenario; left: of the middle of the way; angle: of its walk to the robot's heading; "
        "least: distance between the centres of person and robot"
    )
