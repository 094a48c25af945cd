"""The commands `cosim replay` and `cosim counterfactual`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.options import LOOK
from cosim.cli.progress import doing

counterfactual_app = typer.Typer()


@counterfactual_app.command(
    "counterfactual",
    rich_help_panel=LOOK,
    epilog="Example:  \n`cosim counterfactual runs/mine lh-011-00`",
)
def compare_one(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str, typer.Argument(help="One of its episodes.")],
) -> None:
    """Replay an episode, simulate its street again without the robot, and print whom the robot
    delayed by how much."""
    from cosim.results.delay import DELAY_NEAR_M
    from scenarios.episodes.replay import check, compared, recorded

    with doing(f"reading {episode}") as progress:
        told = recorded(folder, episode)
        state_hash, found = compared(told, progress)
    check(folder, told, state_hash)
    rows = []
    for name, delay in (("people", found.people), ("vehicles", found.vehicles)):
        near, everybody = (
            (f"{delay.near_s:+.1f}", str(delay.near)),
            (f"{delay.delay_s:+.1f}", str(delay.compared)),
        )
        rows.append((name, *near, *everybody, str(delay.unmatched)))
    heads = ("delay of\nthose near, s", "those\nnear", "delay of\nall, s", "all", "not\ncomparable")
    tables.show(out, [*tables.names(episode), *tables.figures(*heads)], rows)
    out.print(
        f"delay: how much later than without the robot, summed; near: came within "
        f"{DELAY_NEAR_M:g} m of it; far from "
        "it the two streets differ by chance; not comparable: not the same in both"
    )


replay_app = typer.Typer()


@replay_app.command(rich_help_panel=LOOK, epilog="Example:  \n`cosim replay runs/mine lh-011-00`")
def replay(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str, typer.Argument(help="One of its episodes.")],
) -> None:
    """Run a finished episode again from its record, injections included, and compare the state
    hash."""
    from scenarios.episodes.replay import check, recorded, replayed

    with doing(f"reading {episode}") as progress:
        told = recorded(folder, episode)
        again = replayed(told, progress=progress)
    check(folder, told, again)
    out.print(f"{episode}: state hash {again}, as recorded", highlight=False)
