"""`cosim export`: a scenario's street as glTF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.output_file import check_output, replaced
from cosim.cli.options.panels import LOOK
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing

export_app = typer.Typer()


@export_app.command(rich_help_panel=LOOK, epilog="Example:  \n`cosim export lh-011-00 street.glb`")
def export(
    scenario: Annotated[str, typer.Argument(help="A scenario's id (`cosim list long-horizon`).")],
    output: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write the street, a .glb.")],
    suite: Annotated[
        str | None, typer.Option(help="Where the scenario is: a suite or a suite's .json file; by default looked up.")
    ] = None,
) -> None:
    """Write the street along a scenario's route as glTF: ground, buildings, trees, furniture, signals, barriers."""
    check_output(output, "glTF", (".glb",))
    from cosim.spec.selection import scenarios_chosen
    from scenarios.catalog import holding, load_suite
    from scenarios.viewing.export import export_street

    (one,) = scenarios_chosen(holding(scenario) if suite is None else load_suite(suite), [scenario])
    instead = replaced(output)
    with doing("reading the scenario") as tell:
        tiles = export_street(one, output, tell)
    size = f"{tiles} tiles, {output.stat().st_size / 1e6:.1f} MB"
    out.print(f"Street: {output} ({one.id}, {size}){instead}", soft_wrap=True, highlight=False)
