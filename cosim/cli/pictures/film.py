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

film_app = typer.Typer()


@film_app.command(
    rich_help_panel=LOOK, epilog="Example:  \n`cosim film runs/mine lh-011-00 --from 30 --to 60 -o film.mp4`"
)
def film(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str, typer.Argument(help="One of its episodes.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to write the film, an .mp4.")] = Path(
        "film.mp4"
    ),
    start: Annotated[float, typer.Option("--from", min=0.0, help="First second.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Last second; by default the end.")] = None,
    size: Annotated[str, typer.Option(help="Width x height in pixels, both even.")] = "1280x720",
    view: Annotated[str, typer.Option(help="follow (from behind), above, or robot: what it sees.")] = "follow",
    speed: Annotated[int, typer.Option(min=1, max=32, help="Times real time.")] = 1,
    camera: Annotated[Choice, typer.Option(metavar="CAMERA", help=CAMERA_HELP)] = "auto",
) -> None:
    """Film an episode of a run: from behind the robot or above it, with what it sees, the map, events and failures."""
    from scenarios.viewing.film import Cut, make_film

    picked = view_of(view)
    until_s = math.inf if end is None else end
    instead = replaced(output)
    with doing("choosing the camera") as tell:
        cut = Cut(start, until_s, size_of(size), speed, camera_here(camera), picked)
        to_s = make_film(folder, episode, output, cut, tell)
    same = (
        "the state hash is the record's" if to_s == math.inf else f"of its first {to_s:g} s every tick is as recorded"
    )
    out.print(f"Film: {output} ({same}){instead}", soft_wrap=True, highlight=False)
