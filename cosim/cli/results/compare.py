"""The command line of comparisons: `cosim compare`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from cosim.cli.options.output_file import replaced
from cosim.cli.options.panels import TRUST
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing
from cosim.core.errors import UsageError, unwritable

if TYPE_CHECKING:
    from cosim.records.comparison import RunComparison

compare_app = typer.Typer()
_OUTPUT_HELP = "Write it too: .csv (all metrics; flipped scenarios go into NAME.flipped.csv), .md, .tex; repeatable."


@compare_app.command(
    rich_help_panel=TRUST,
    epilog="Examples:  \n`cosim compare runs/before runs/after`  \n"
    "`cosim compare runs/straight runs/mine runs/other -o all.csv -o table.md -o table.tex`",
)
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN OTHER...", help="Run folders of one suite.")],
    outputs: Annotated[list[Path] | None, typer.Option("-o", "--output", help=_OUTPUT_HELP)] = None,
) -> None:
    """Compare runs with the first one, paired by scenario: what differs, what is noise, which scenarios flipped.

    Over the whole suite, and by event, structure and split; intervals of the difference by drawing scenarios again.
    """
    from cosim.records.comparison import compare_runs
    from cosim.report.compared import FORMATS

    for path in outputs or ():
        if path.suffix not in (".csv", *FORMATS):
            raise UsageError(f"{path}: its name must end in .csv, {', '.join(FORMATS)}: so the format is chosen")
    with doing(f"comparing {len(folders)} runs"):
        told = compare_runs(folders)
    instead = {path: replaced(path) for path in outputs or ()}
    for path in outputs or ():
        if path.suffix == ".csv":
            _write(path, told.differences.to_csv(index=False))
            _write(path.with_suffix(".flipped.csv"), told.flipped.to_csv(index=False))
        else:
            _write(path, FORMATS[path.suffix](told))
    print_comparison(out, told)
    for path, said in instead.items():
        out.print(f"Written: {path}{said}", soft_wrap=True, markup=False, highlight=False)


def print_comparison(out: Console, told: RunComparison) -> None:
    """What is compared, a table of each run's whole suite and one of its groups, and what flipped: for 80 columns."""
    from cosim.cli.terminal.run_table import print_terms
    from cosim.report.compared import flips_in_words, how_to_read, tables_of_comparison

    for run in (told.before, *told.others):
        out.print(f"{run.label}: {run.path}", soft_wrap=True, markup=False, highlight=False)
        print_terms(out, run.table, run.path)
    for other in told.others:
        for table in tables_of_comparison(told, other):
            out.print(table.title, soft_wrap=True, markup=False, highlight=False)
            names = [Column(head, overflow="fold") for head in table.heads[: table.names]]
            figures = [Column(head, no_wrap=True, justify="right") for head in table.heads[table.names : -1]]
            shown = Table(
                *names, *figures, Column(table.heads[-1], no_wrap=True), box=box.SIMPLE_HEAD, padding=0, show_edge=False
            )
            for row in table.rows:
                shown.add_row(*map(Text, row))
            print_fitted(out, shown, table.names)
        for line in flips_in_words(told, other):
            out.print(line, soft_wrap=not out.is_terminal, markup=False, highlight=False)
    for note in (*told.notes, how_to_read(told)):
        out.print(note, soft_wrap=not out.is_terminal, markup=False, highlight=False)


def _write(path: Path, text: str) -> None:
    from cosim.core.whole_file import write_whole

    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise unwritable(path, error) from error
