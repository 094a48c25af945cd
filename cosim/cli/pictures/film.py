"""`cosim film`: an episode as a film."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.camera import CAMERA_HELP, Choice, camera_here
from cosim.cli.options.output_file import replaced
from cosim.cli.options.panels import LOOK
from cosim.cli.pictures.view import size_of, view_of
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import UsageError, listed

film_app = typer.Typer()


@film_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim film runs/mine lh-011-00 --from 30 --to 60 -o film.mp4`  \n"
    "`cosim film runs/mine --failure --view above`",
)
def film(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[
        str | None, typer.Argument(help="One of its episodes; with --failure by default the first that failed.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to write the film, an .mp4.")] = Path(
        "film.mp4"
    ),
    failure: Annotated[
        bool, typer.Option("--failure", help="Film the first failure: 10 s before it to 2 s after it.")
    ] = False,
    start: Annotated[
        float | None,
        typer.Option("--from", min=0.0, help="First second of the episode.", show_default="0, or as --failure says"),
    ] = None,
    end: Annotated[
        float | None,
        typer.Option("--to", help="Last second of the episode.", show_default="the end, or as --failure says"),
    ] = None,
    size: Annotated[str, typer.Option(help="Width x height in pixels, both even.")] = "1280x720",
    view: Annotated[str, typer.Option(help="follow (from behind), above, or robot: what it sees.")] = "follow",
    speed: Annotated[int, typer.Option(min=1, max=32, help="Times real time.")] = 1,
    camera: Annotated[Choice, typer.Option(metavar="CAMERA", help=CAMERA_HELP)] = "auto",
) -> None:
    """Film an episode of a run: from behind the robot or above it, with what it sees, the map, events and failures."""
    from scenarios.viewing.film import Cut, failure_to_film, make_film

    picked = view_of(view)
    from_s, until_s = 0.0, math.inf
    if failure:
        shown = failure_to_film(folder, episode)
        episode, from_s, until_s = shown.scenario, shown.from_s, shown.to_s
        out.print(f"Failure: {episode}, {shown.at_s:.1f} s: {shown.reason}", soft_wrap=True, highlight=False)
    if episode is None:
        raise UsageError(f"{folder}: name one of its episodes, or give --failure: {_episodes(folder)}")
    from_s, until_s = from_s if start is None else start, until_s if end is None else end
    instead = replaced(output)
    with doing("choosing the camera") as tell:
        cut = Cut(from_s, until_s, size_of(size), speed, camera_here(camera), picked)
        to_s = make_film(folder, episode, output, cut, tell)
    same = (
        "the state hash is the record's" if to_s == math.inf else f"of its first {to_s:g} s every tick is as recorded"
    )
    out.print(f"Film: {output} ({same}){instead}", soft_wrap=True, highlight=False)


def _episodes(folder: Path) -> str:
    """List the finished episodes of a run."""
    from cosim.records.run_folder import read_records

    return listed("", [record.scenario for record in read_records(folder)])
