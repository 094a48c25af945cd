"""`cosim merge`: the shards of a run, put together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.panels import MANY
from cosim.cli.terminal.consoles import err, out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import SOME_CRASHED

merge_app = typer.Typer()


@merge_app.command(
    rich_help_panel=MANY,
    epilog="Examples:  \n"
    "`cosim run reactive --policy orca --seed 7 --shard 1/2 --out runs/1`, and `2/2` on another machine  \n"
    "`cosim merge runs/1 runs/2 --out runs/orca`  \n"
    "`cosim run reactive --policy orca --seed 7 --out runs/orca --resume`, where episodes are missing",
)
def merge(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders: shards of one run.")],
    target: Annotated[Path, typer.Option("--out", help="The run folder to make.")],
) -> None:
    """Make one run folder of the shards of a run: the table is that of a run in one piece, to the byte.

    Folders of different runs are refused, and so are different episodes of one scenario; equal ones are taken once.
    Missing scenarios are named, exit code 1: `cosim run --resume` runs them.
    """
    from cosim.cli.terminal.run_table import kinds_of, print_by_kind, print_table
    from cosim.records.merging import merge_runs

    with doing("reading the shards") as tell:
        merged = merge_runs(folders, target, tell)
    print_table(out, merged.table, len(merged.spec.scenarios), target)
    print_by_kind(out, merged.table, kinds_of(target))
    out.print(f"Run folder: {target}", soft_wrap=True)
    if merged.twice:
        err.print(f"{len(merged.twice)} scenarios came twice, equal to the bit, and were taken once.", highlight=False)
    if merged.missing:
        err.print(
            f"{len(merged.missing)} scenarios are missing: {', '.join(merged.missing)}: give the command of the run "
            f"without --shard, with --seed {merged.spec.seed} --out {target} --resume",
            soft_wrap=True, markup=False, highlight=False,
        )  # fmt: skip
    if merged.missing or merged.table["ended"].isna().any():
        raise typer.Exit(SOME_CRASHED)
