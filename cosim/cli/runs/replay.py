"""`cosim replay`: a finished episode again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.panels import LOOK
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing

replay_app = typer.Typer()


@replay_app.command(rich_help_panel=LOOK, epilog="Example:  \n`cosim replay runs/mine lh-011-00`")
def replay(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str, typer.Argument(help="One of its episodes.")],
) -> None:
    """Run a finished episode again from its record, injections included, and compare the state hash."""
    from scenarios.execution.replay import check, recorded, replayed

    with doing(f"reading {episode}") as tell:
        told = recorded(folder, episode)
        again = replayed(told, tell=tell)
    check(folder, told, again)
    out.print(f"{episode}: state hash {again}, as recorded", highlight=False)
