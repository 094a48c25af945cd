"""The commands `cosim show`, `score`, `compare`, `merge` and `report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console

from cosim.cli import tables
from cosim.cli.console import err, notice, out, say
from cosim.cli.options import (
    LOOK,
    MANY,
    RERUN_HELP,
    TRUST,
    Camera,
    camera_here,
    check_output,
    replacement_note,
    write_rerun,
)
from cosim.cli.progress import doing
from cosim.core.errors import SOME_CRASHED, UsageError, unknown, unwritable
from cosim.core.units import milliseconds

if TYPE_CHECKING:
    import pandas as pd

    from cosim.results.compare import RunComparison
    from cosim.results.record import Record


compare_app = typer.Typer()
_OUTPUT_HELP = (
    "Write it too: .csv (all metrics; flipped scenarios go into NAME.flipped.csv), .md, .tex, "
    ".png (see --by); repeatable."
)


@compare_app.command(
    rich_help_panel=TRUST,
    epilog="Examples:  \n`cosim compare runs/before runs/after`  \n"
    "`cosim compare runs/straight runs/mine runs/other -o all.csv -o table.md -o table.tex`",
)
def compare(
    folders: Annotated[
        list[Path], typer.Argument(metavar="RUN OTHER...", help="Run folders of one suite.")
    ],
    outputs: Annotated[list[Path] | None, typer.Option("-o", "--output", help=_OUTPUT_HELP)] = None,
    by: Annotated[
        str,
        typer.Option(
            metavar="weather|policy",
            help="Axis of the .png: the weather, with a line for each policy, or the policies in "
            "the order given.",
        ),
    ] = "weather",
) -> None:
    """Compare runs with the first one, paired by scenario; runs in several weathers also by these.

    Prints differences with their intervals over the suite, and by event, structure and split.
    Lists the scenarios whose result flipped.
    """
    from cosim.report.compared import FORMATS
    from cosim.results.compare import compare_runs
    from scenarios.suites.exploits import exploit_of

    if by not in _AXES:
        raise unknown("axis of --by", by, _AXES)
    for path in outputs or ():
        if path.suffix not in (".csv", ".png", *FORMATS):
            raise UsageError(
                f"{path}: its name must end in .csv, .png, {', '.join(FORMATS)}: so the format is "
                "chosen"
            )
    with doing(f"comparing {len(folders)} runs"):
        comparison = compare_runs(folders)
    instead = {path: replacement_note(path) for path in outputs or ()}
    for path in outputs or ():
        if path.suffix == ".csv":
            _write(path, comparison.differences.to_csv(index=False))
            _write(path.with_suffix(".flipped.csv"), comparison.flipped.to_csv(index=False))
        elif path.suffix == ".png":
            _write(path, _picture_of(comparison, by))
        else:
            _write(path, FORMATS[path.suffix](comparison))
    print_comparison(out, comparison)
    table = comparison.before.table
    for suite_hash in dict.fromkeys(table["suite_hash"]):
        if (exploit := exploit_of(suite_hash, table["robot"])) is None:
            continue
        out.print(exploit.in_words, soft_wrap=not out.is_terminal, highlight=False)
    for path, remark in instead.items():
        say(f"Written: {path}{remark}")


_AXES: Final = ("weather", "policy")


def _picture_of(comparison: RunComparison, by: str) -> bytes:
    """Draw the means of all runs with their intervals, as PNG. by: one of _AXES."""
    from cosim.report.compared import summary_by_policy, summary_by_weather
    from cosim.report.curves import DRAWN, DRAWN_BY_POLICY, draw_curves

    title = f"{comparison.suite} by {by}"
    if by == "weather":
        return draw_curves(summary_by_weather(comparison), ("weather", "policy"), DRAWN, title)
    summary = summary_by_policy(comparison)
    drawn = [name for name in DRAWN_BY_POLICY if (summary["metric"] == name).any()]
    return draw_curves(summary, ("policy",), drawn, title, joined=False)


def print_comparison(out: Console, comparison: RunComparison) -> None:
    """Print a comparison of runs: terms, tables by suite and group, and flipped scenarios."""
    from cosim.cli.run_table import print_terms
    from cosim.report.compared import (
        flips_in_words,
        how_to_read,
        summary_by_weather,
        table_by_weather,
        tables_of_comparison,
    )

    for run in (comparison.before, *comparison.others):
        out.print(f"{run.label}: {run.path}", soft_wrap=True, markup=False, highlight=False)
        print_terms(out, run.table, run.path)
    for other in comparison.others:
        for table in tables_of_comparison(comparison, other):
            out.print(table.title, soft_wrap=True, markup=False, highlight=False)
            *heads, last = table.heads
            columns = [*tables.names(*heads[: table.names]), *tables.figures(*heads[table.names :])]
            columns += tables.labels(last)
            tables.show(out, columns, table.rows)
        for line in flips_in_words(comparison, other):
            out.print(line, soft_wrap=not out.is_terminal, markup=False, highlight=False)
    summary = summary_by_weather(comparison)
    if summary["weather"].nunique() > 1:
        table = table_by_weather(summary)
        out.print(table.title, soft_wrap=True, markup=False, highlight=False)
        names, figures = table.heads[: table.names], table.heads[table.names :]
        tables.show(out, [*tables.names(*names), *tables.figures(*figures)], table.rows)
    for note in (*comparison.notes, how_to_read(comparison)):
        out.print(note, soft_wrap=not out.is_terminal, markup=False, highlight=False)


def _write(path: Path, content: str | bytes) -> None:
    from cosim.core.files import write_atomic

    try:
        write_atomic(path, content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise unwritable(path, error) from error


report_app = typer.Typer()


@report_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim report runs/mine -o report.html`  \n"
    "`cosim report runs/unit-mine runs/reactive-mine runs/reactive-theirs --failures 24`",
)
def report(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Where to write the page, an .html.")
    ] = Path("report.html"),
    failures: Annotated[
        int, typer.Option(min=0, max=200, help="Replay at most so many failures.")
    ] = 48,
    within: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="Replay the first failure of an episode, and others within so many seconds.",
        ),
    ] = 150.0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes for the replays.")] = 2,
    camera: Camera = "auto",
) -> None:
    """Write a report of runs as one HTML file: tables, plots, maps and replays of failures.

    The file opens from disk and loads nothing from the network. The tables include the paper's.
    Failures are drawn by running their episodes again.
    """
    check_output(output, "a page", (".html", ".htm"))
    from scenarios.tools.viewing.report import make_report

    instead = replacement_note(output)
    with doing("choosing the camera") as progress:
        drawn_by = camera_here(camera)
        made = make_report(
            folders,
            output,
            camera=drawn_by,
            jobs=jobs,
            most=failures,
            within_s=within,
            progress=progress,
        )
    limit = f": {made.limit}" if made.limit else ""
    size = f"{made.size_bytes / 1e6:.1f} MB, {made.shown} of {made.failures} failures{limit}"
    out.print(f"Report: {output} ({size}){instead}", soft_wrap=True, highlight=False)


score_app = typer.Typer()


@score_app.command(rich_help_panel=TRUST, epilog="Example:  \n`cosim score runs/mine`")
def score(folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")]) -> None:
    """Compute every metric of a run again from its trajectories, and compare it to the bit.

    No engine is started. A difference is printed, with exit code 1.
    """
    from cosim.results.metrics import METRICS
    from cosim.results.rescore import score_run
    from cosim.results.run_setup import METRIC_SCHEMA

    with doing(f"reading {folder}") as progress:
        scored = score_run(folder, progress)
    lines = [
        f"{scored.episodes} episodes, {len(METRICS)} metrics each, by metric schema {METRIC_SCHEMA}"
    ]
    if lacking := scored.scheduled - scored.episodes - scored.without_trajectory:
        lines.append(
            f"{lacking} of {scored.scheduled} scheduled episodes have not ended: results.csv "
            f"is not looked at"
        )
    if scored.without_trajectory:
        lines.append(
            f"{scored.without_trajectory} have no trajectory: their policy crashed, or an "
            f"engine failed"
        )
    if scored.untested:
        lines.append(
            f"not computed from trajectories: {', '.join(scored.untested)}: `cosim counterfactual`"
        )
    if not scored.differences:
        files = ("record.json", "results.sqlite", *["results.csv"] * scored.table)
        lines.append(f"equal to the bit to {', '.join(files)}")
    for line in lines:
        say(line)
    if scored.differences:
        first = scored.differences[0]
        episodes = {one.episode for one in scored.differences}
        say(
            f"different: episode {first.episode}, {first.metric} in {first.file}: recorded "
            f"{first.recorded}, computed {first.computed} (differences: {len(scored.differences)}, "
            f"episodes: {len(episodes)})"
        )
        raise typer.Exit(SOME_CRASHED)


show_app = typer.Typer()
_BAG_HELP = "Write the episode as a ROS 2 bag (rosbag2, MCAP; package extra [ros2]), from a replay."


@show_app.command(
    epilog="Examples:  \n`cosim show runs/mine`  \n`cosim show runs/mine --events`  \n"
    "`cosim show runs/mine --episode lh-011-00 -o episode.png`  \n"
    "`cosim show runs/mine --episode lh-011-00 --rerun episode.rrd`  \n"
    "`cosim show runs/mine --episode lh-011-00 --bag episode-bag`"
)
def show(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[
        str | None, typer.Option(help="One episode: its failures and events, and a picture.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("-o", "--output", help="Where to write the episode's picture.")
    ] = None,
    events: Annotated[
        bool, typer.Option("--events", help="Measured values of every event, from its tracks.")
    ] = False,
    rerun: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help=RERUN_HELP)] = None,
    bag: Annotated[Path | None, typer.Option(metavar="FOLDER", help=_BAG_HELP)] = None,
    bag_camera: Annotated[
        str, typer.Option(metavar="WxH[@DEG]", help="Camera of --bag, in place of the policy's.")
    ] = "",
) -> None:
    """Show the table of a run, finished or not, or one episode as a picture from above."""
    from cosim.results.run_folder import read_records, read_spec
    from cosim.results.verified_run import check_record_file

    spec = read_spec(folder)
    records = {record.scenario.id: record for record in read_records(folder)}
    if rerun is not None:
        write_rerun(folder, [] if episode is None else [episode], rerun)
        return
    if bag is not None or bag_camera:
        _write_bag(folder, episode, bag, bag_camera)
        return
    for record in records.values():
        check_record_file(folder, record)
    if events:
        if episode is not None:
            raise UsageError("--events is about a whole run: leave --episode out")
        from scenarios.tools.viewing.event_sheet import sheet_of_run

        print_sheet(out, sheet_of_run(folder))
        return
    if episode is None:
        _show_run(folder, [*records.values()], len(spec.scenarios))
        return
    if episode not in records:
        raise unknown(f"finished episode in {folder}", episode, records)
    _show_episode(folder, records[episode], picture)


def _show_run(folder: Path, records: Sequence[Record], scheduled: int) -> None:
    """Print the table of a run, with a note if its metrics are of another schema."""
    from cosim.cli.run_table import kinds_of, print_by_kind, print_table
    from cosim.results.table import table_of
    from cosim.results.verified_run import other_schema

    table = table_of(records)
    print_table(out, table, scheduled, folder)
    print_by_kind(out, table, kinds_of(folder))
    if words := next(filter(None, map(other_schema, records)), ""):
        out.print(
            f"{words}: its values are shown as recorded, and pooled rates may be missing",
            soft_wrap=True,
            highlight=False,
        )


def _show_episode(folder: Path, record: Record, picture: Path | None) -> None:
    """Print the result of an episode, and draw it from above if it ended. Raises UsageError."""
    from scenarios.tools.viewing.episode_pictures import draw_episode

    episode = record.scenario.id
    print_episode(out, record)
    if record.ended is None and picture is not None:
        raise UsageError(
            f"episode '{episode}' is {record.status}: it has no track to draw. Leave -o out"
        )
    if record.ended is not None:
        path = picture or folder / "episodes" / episode / "above.png"
        instead = replacement_note(picture)
        with doing(f"drawing {episode}"):
            draw_episode(folder, episode, path)
        out.print(f"Picture: {path}{instead}", soft_wrap=True)


def _write_bag(folder: Path, episode: str | None, bag: Path | None, camera: str) -> None:
    """Write the bag of an episode, and print its path. Raises UsageError."""
    from cosim.spec.ros2 import camera_called
    from scenarios.tools.viewing.bag import write_bag

    if bag is None or episode is None:
        raise UsageError("--bag is of one episode: name it with --episode")
    picture = camera_called(camera, "--bag-camera") if camera else None
    with doing(f"recording {episode}") as progress:
        count = write_bag(folder, episode, bag, picture=picture, progress=progress)
    size = sum(file.stat().st_size for file in bag.iterdir()) / 1e6
    words = f"Bag: {bag} ({count} messages, {size:.1f} MB, the state hash is the record's)"
    out.print(words, soft_wrap=True, highlight=False)


def print_episode(out: Console, record: Record) -> None:
    """Print the result, failures, events and metrics of an episode."""
    from cosim.cli.run_table import value_in_words
    from cosim.core.clock import Clock
    from cosim.results.metrics import COUNTERFACTUAL, METRICS

    decoy_of = f" (decoy of {record.scenario.decoy_of})" if record.scenario.decoy_of else ""
    out.print(
        f"{record.scenario.id}{decoy_of}: {record.status} {record.ended or ''} {record.reason}",
        soft_wrap=True,
        markup=False,
    )
    if record.setup.latency_ms or record.setup.real_time:
        real = (
            ", a median in whole ticks of 50 ms: replayed, never made again"
            if record.setup.real_time
            else ""
        )
        took = (
            ""
            if record.answer_ms is None
            else f"an answer took {milliseconds(record.answer_ms)} (median); "
        )
        out.print(
            f"  {took}commands took effect {record.setup.latency_ms:g} ms after what they "
            f"answer{real}",
            soft_wrap=True,
        )
    for failure in record.failures:
        what = f" with {failure.other_kind} {failure.other}" if failure.other else ""
        fault = f", {failure.fault}" if failure.fault else ""
        out.print(
            f"  {Clock().time_s(failure.tick):7.2f} s  {failure.kind}{what} at "
            f"{failure.route_s_m:.1f} m{fault}"
        )
    for contact in record.walked_into:
        what = f"{contact.suffered} by {contact.other}"
        where = f"at {contact.route_s_m:.1f} m, {contact.fault}"
        out.print(f"  {Clock().time_s(contact.tick):7.2f} s  {what} {where}")
    for event in record.events:
        at = (
            "never triggered"
            if event.triggered_at_s is None
            else f"triggered at {event.triggered_at_s:.2f} s"
        )
        passing = (
            ""
            if event.passed_at_s is None
            else f", passed at {event.passed_at_s:.2f} s: on average {event.passing_mps:.2f} m/s, "
            f"longest stop {event.stopped_s:.2f} s"
        )
        broken = ", rule not met" if event.rule_met is False else ""
        out.print(f"  event {event.id} {event.kind}: {at}{passing}{broken}")
    units = {name: metric.unit for name, metric in METRICS.items()}
    units |= {name: unit for name, unit in COUNTERFACTUAL.items() if name in record.measures}
    rows = [(name, value_in_words(record.measures.get(name)), unit) for name, unit in units.items()]
    tables.show(
        out, [*tables.names("metric"), *tables.figures("value"), *tables.labels("unit")], rows
    )


def print_sheet(out: Console, sheet: pd.DataFrame) -> None:
    """Print the measured events of a run (`scenarios.tools.viewing.event_sheet`), and summaries."""
    from scenarios.tools.viewing.event_sheet import summary

    if sheet.empty:
        out.print("No event of this run's episodes was triggered.")
        return
    heads = (
        "stated\nm",
        "trigger\nm",
        "error\nm",
        "tick\nm",
        "speed\nm/s",
        "stated\nm/s",
        "left\nm",
        "angle\ndeg",
        "least\nm",
    )
    rows = []
    for row in sheet.itertuples(index=False):
        name = row[0] if row[0].startswith(row[1]) else f"{row[0]} {row[1]}"
        numbers = (
            f"{value:.{digits}f}"
            for value, digits in zip(row[2:], (2, 2, 3, 3, 2, 2, 2, 0, 2), strict=True)
        )
        rows.append((name, *("-" if n == "nan" else n for n in numbers)))
    tables.show(out, [*tables.names("episode"), *tables.figures(*heads)], rows)
    for short in summary(sheet):
        kind, *others = short.columns
        counts = [tuple(str(value) for value in row) for row in short.itertuples(index=False)]
        tables.show(out, [*tables.names(kind), *tables.figures(*others)], counts)
    out.print(
        "stated: trigger distance and speed by the scenario; trigger: distance from the robot to "
        "the event's place when it began; error: difference to the stated distance; tick: metres "
        "that the robot drove in a tick, the largest expected error; off: triggers beyond it; "
        "speed: of the walking person; left: of the middle of the route; angle: between "
        "its walk and the robot's heading; least: distance between the centres of person and robot"
    )


merge_app = typer.Typer()


@merge_app.command(
    rich_help_panel=MANY,
    epilog="Examples:  \n`cosim run reactive --policy orca --seed 7 --shard 1/2 --out runs/1`, "
    "and `2/2` on another machine  \n`cosim merge runs/1 runs/2 --out runs/orca`  \n`cosim run "
    "reactive --policy orca --seed 7 --out runs/orca --resume`, where episodes are missing",
)
def merge(
    folders: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Run folders: shards of one run.")
    ],
    target: Annotated[Path, typer.Option("--out", help="The run folder to make.")],
) -> None:
    """Merge the shards of a run into one run folder, with the same table to the byte.

    Folders of different runs, and different results of one scenario, are refused. Missing
    scenarios are named, with exit code 1; `cosim run --resume` runs them.
    """
    from cosim.cli.run_table import kinds_of, print_by_kind, print_table
    from cosim.results.merge import merge_runs

    with doing("reading the shards") as progress:
        merged = merge_runs(folders, target, progress)
    print_table(out, merged.table, len(merged.spec.scenarios), target)
    print_by_kind(out, merged.table, kinds_of(target))
    out.print(f"Run folder: {target}", soft_wrap=True)
    if merged.twice:
        err.print(
            f"{len(merged.twice)} scenarios came twice, equal to the bit, and were taken once.",
            highlight=False,
        )
    if merged.missing:
        notice(
            f"{len(merged.missing)} scenarios are missing: {', '.join(merged.missing)}: give "
            f"the command of the run "
            f"without --shard, with --seed {merged.spec.setup.seed} --out {target} --resume"
        )
    if merged.missing or merged.table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)
