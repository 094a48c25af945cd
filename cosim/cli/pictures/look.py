"""`cosim look`: one picture of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.camera import CAMERA_HELP, Choice, camera_here
from cosim.cli.options.output_file import check_output, replaced
from cosim.cli.options.panels import LOOK
from cosim.cli.options.street import CHILDREN_HELP, ELDERLY_HELP, GROUPS_HELP, RESIDENTS_HELP, ROBOT_HELP
from cosim.cli.pictures.view import size_of, view_of
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import MachineError, UsageError

look_app = typer.Typer()


@look_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim look lh-011-00 --at 20 -o frame.png`  \n`cosim look lh-011-00 --residents 8`  \n"
    "`cosim look mine.toml --scenario 2 --view above`",
)
def look(
    scenario: Annotated[
        str, typer.Argument(help="A scenario's id (`cosim list long-horizon`), or a file: your .toml, a suite's .json.")
    ],
    which: Annotated[
        str | None,
        typer.Option("--scenario", help="Of a file, which scenario: its id or its number; by default the first."),
    ] = None,
    at: Annotated[float, typer.Option(min=0.0, help="Seconds into the episode.")] = 0.0,
    view: Annotated[str, typer.Option(help="robot, follow (from behind) or above.")] = "robot",
    size: Annotated[str, typer.Option(help="Width x height in pixels.")] = "1280x720",
    suite: Annotated[
        str | None, typer.Option(help="Where the scenario is: a suite or a suite's .json file; by default looked up.")
    ] = None,
    policy: Annotated[str, typer.Option(help="Who drives until then.")] = "route",
    robot: Annotated[str, typer.Option(help=ROBOT_HELP)] = "",
    residents: Annotated[int | None, typer.Option(min=0, help=RESIDENTS_HELP)] = None,
    groups: Annotated[float | None, typer.Option(help=GROUPS_HELP)] = None,
    elderly: Annotated[float | None, typer.Option(help=ELDERLY_HELP)] = None,
    children: Annotated[float | None, typer.Option(help=CHILDREN_HELP)] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Where to write the picture.")] = Path("look.png"),
    camera: Annotated[Choice, typer.Option(metavar="CAMERA", help=CAMERA_HELP)] = "auto",
) -> None:
    """Look at a scenario: one picture of what the robot sees, or of the robot in its street."""
    from scenarios.catalog import one_scenario, with_crowd, with_robot
    from scenarios.viewing.look import look_at

    picked = view_of(view)
    pixels = size_of(size)
    check_output(output)
    found, of = one_scenario(scenario, suite, which)
    asked = with_crowd(with_robot(found, robot), residents=residents, groups=groups, elderly=elderly, children=children)
    (one,) = asked.scenarios
    more = "" if which or of == 1 else f"; 1 of {of} scenarios: --scenario chooses another"
    with doing("choosing the camera") as tell:
        image, time_s = look_at(one, policy, at, picked, pixels, camera_here(camera), tell)
    instead = replaced(output)
    _save(image, output)
    out.print(f"Picture: {output} ({one.id} at {time_s:.2f} s, {view}{more}){instead}", soft_wrap=True, highlight=False)


def _save(image: object, path: Path) -> None:
    """Write a picture. Raises MachineError when it cannot be written there."""
    import cv2
    import numpy as np

    try:
        written = cv2.imwrite(str(path), np.asarray(image)[..., ::-1])
    except cv2.error as error:
        raise UsageError(f"{path}: cannot be written as a picture; use a name that ends in .png or .jpg") from error
    if not written:
        raise MachineError(f"{path}: the picture cannot be written there")
