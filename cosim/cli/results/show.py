"""`cosim show`: the table of a run, of one episode, of its events."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Column, Table

from cosim.cli.options.output_file import replaced
from cosim.cli.options.recording import RERUN_HELP, write_rerun
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing
from cosim.core.errors import UsageError, unknown
from cosim.core.telling import milliseconds

if TYPE_CHECKING:
    import pandas as pd

    from cosim.records.record import Record

show_app = typer.Typer()


@show_app.command(
    epilog="Examples:  \n`cosim show runs/mine`  \n`cosim show runs/mine --events`  \n"
    "`cosim show runs/mine --episode lh-011-00 -o episode.png`  \n"
    "`cosim show runs/mine --episode lh-011-00 --rerun episode.rrd`"
)
def show(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str | None, typer.Option(help="One episode: its failures and events, and a picture.")] = None,
    picture: Annotated[
        Path | None, typer.Option("-o", "--output", help="Where to write the episode's picture.")
    ] = None,
    events: Annotated[
        bool, typer.Option("--events", help="What was measured of every event, from its tracks.")
    ] = False,
    rerun: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help=RERUN_HELP)] = None,
) -> None:
    """Show the table of a run, finished or not, or one episode as a picture from above."""
    from cosim.cli.terminal.run_table import kinds_of, print_by_kind, print_table
    from cosim.records.results import table_of
    from cosim.records.run_folder import read_records, read_spec
    from cosim.records.whole_run import check_record_file

    spec = read_spec(folder)
    records = {record.scenario: record for record in read_records(folder)}
    if rerun is not None:
        write_rerun(folder, [] if episode is None else [episode], rerun)
        return
    for record in records.values():
        check_record_file(folder, record)
    if events:
        if episode is not None:
            raise UsageError("--events is about a whole run: leave --episode out")
        from scenarios.viewing.eventsheet import sheet_of_run

        print_sheet(out, sheet_of_run(folder))
        return
    if episode is None:
        table = table_of(records.values())
        print_table(out, table, len(spec.scenarios), folder)
        print_by_kind(out, table, kinds_of(folder))
        return
    if episode not in records:
        raise unknown(f"finished episode in {folder}", episode, records)
    from scenarios.viewing.picture import draw_episode

    record = records[episode]
    print_episode(out, record)
    if record.ended is None and picture is not None:
        raise UsageError(f"episode '{episode}' is {record.status}: it has no track to draw. Leave -o out")
    if record.ended is not None:
        path = picture or folder / "episodes" / episode / "above.png"
        instead = replaced(picture)
        with doing(f"drawing {episode}"):
            draw_episode(folder, episode, path)
        out.print(f"Picture: {path}{instead}", soft_wrap=True)


def print_episode(out: Console, record: Record) -> None:
    """One episode in words: how it ended, every failure, every event, every metric."""
    from cosim.cli.terminal.run_table import value_in_words
    from cosim.core.clock import Clock
    from cosim.judge.metrics import COUNTERFACTUAL, METRICS

    out.print(f"{record.scenario}: {record.status} {record.ended or ''} {record.reason}", soft_wrap=True, markup=False)
    if record.latency_ms or record.real_time:
        real = ", a median in whole ticks of 50 ms: replayed, never made again" if record.real_time else ""
        took = "" if record.answer_ms is None else f"an answer took {milliseconds(record.answer_ms)} (median); "
        out.print(f"  {took}commands took effect {record.latency_ms:g} ms after what they answer{real}", soft_wrap=True)
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
        table.add_row(name, value_in_words(record.measures.get(name)), metric.unit)
    for name, unit in COUNTERFACTUAL.items():
        if name in record.measures:
            table.add_row(name, value_in_words(record.measures[name]), unit)
    print_fitted(out, table)


def print_sheet(out: Console, sheet: pd.DataFrame) -> None:
    """What was measured of each event of a run (`scenarios.viewing.eventsheet`), and two summaries by kind: for 80
    columns."""
    from scenarios.viewing.eventsheet import summary

    if sheet.empty:
        out.print("No event of this run's episodes was triggered.")
        return
    heads = ("trigger\nm", "error\nm", "tick\nm", "speed\nm/s", "stated\nm/s", "left\nm", "angle\ndeg", "least\nm")
    columns = (Column(head, justify="right", no_wrap=True) for head in heads)
    rows = Table(Column("episode", overflow="fold"), *columns, box=box.SIMPLE_HEAD, padding=0)
    for row in sheet.itertuples(index=False):
        name = row[0] if row[0].startswith(row[1]) else f"{row[0]} {row[1]}"
        numbers = (f"{value:.{digits}f}" for value, digits in zip(row[2:], (2, 3, 3, 2, 2, 2, 0, 2), strict=True))
        rows.add_row(name, *("-" if n == "nan" else n for n in numbers))
    print_fitted(out, rows)
    for short in summary(sheet):
        columns = (Column(head, no_wrap=True) for head in short.columns)
        table = Table(*columns, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for row in short.itertuples(index=False):
            table.add_row(*(str(value) for value in row))
        print_fitted(out, table)
    out.print(
        "trigger: from the robot to the event's place, when it began; error: off what is stated; tick: what the robot "
        "drove in a tick, the most that the error may be; off: triggers beyond that; speed: of the person while it "
        "walks, stated: of the scenario; left: of the middle of the way; angle: of its walk to the robot's heading; "
        "least: distance between the centres of person and robot"
    )
