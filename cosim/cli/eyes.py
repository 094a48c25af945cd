"""The command line for eyes: `cosim look`, `cosim film`, `cosim export`."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from cosim.cli.consoles import err, out
from cosim.cli.crowd import CHILDREN_HELP, ELDERLY_HELP, GROUPS_HELP
from cosim.cli.progress import doing
from cosim.core.errors import MachineError, UsageError, unknown

if TYPE_CHECKING:
    from scenarios.viewing.look import Viewpoint

PICTURES = (".png", ".jpg", ".jpeg")

Choice = Literal["auto", "gl", "bullet", "bullet-egl"]
CAMERA_HELP = (
    "What draws the pictures: gl (OpenGL), bullet (slow, bare, anywhere), bullet-egl (bare, by OpenGL), or auto: gl "
    "where it works, else bullet."
)
RERUN_HELP = "Write one episode as a recording for the Rerun viewer (package extra [rerun]): it is replayed for that."
ROBOT_HELP = "In place of the scenario's: which robot drives, by its name (`cosim list`)."
RESIDENTS_HELP = "In place of the scenario's: so many people who sit on benches, look into shop windows, wait at stops."


def camera_here(choice: Choice) -> Literal["gl", "bullet", "bullet-egl"]:
    """The camera that a choice comes to on this machine; says so where auto is not gl. Raises EngineError."""
    from physics.cameras.choice import camera_of_choice

    name = camera_of_choice(choice)
    if choice == "auto" and name == "bullet":
        err.print("No OpenGL here: the bullet camera draws the pictures (`cosim doctor` says why).")
    return name


def look(
    scenario: Annotated[str, typer.Argument(help="A scenario's id (`cosim list long-horizon`).")],
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
    from scenarios.catalog import holding, load_suite, scenarios_chosen, with_crowd, with_robot
    from scenarios.viewing.look import look_at

    picked = view_of(view)
    pixels = size_of(size)
    check_output(output)
    found = holding(scenario) if suite is None else load_suite(suite)
    whole = with_crowd(with_robot(found, robot), residents=residents, groups=groups, elderly=elderly, children=children)
    (one,) = scenarios_chosen(whole, [scenario])
    with doing("choosing the camera") as tell:
        image, time_s = look_at(one, policy, at, picked, pixels, camera_here(camera), tell)
    save(image, output)
    out.print(f"Picture: {output} ({one.id} at {time_s:.2f} s, {view})", soft_wrap=True, highlight=False)


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
    with doing("choosing the camera") as tell:
        cut = Cut(start, until_s, size_of(size), speed, camera_here(camera), picked)
        to_s = make_film(folder, episode, output, cut, tell)
    same = (
        "the state hash is the record's" if to_s == math.inf else f"of its first {to_s:g} s every tick is as recorded"
    )
    out.print(f"Film: {output} ({same})", soft_wrap=True, highlight=False)


def export(
    scenario: Annotated[str, typer.Argument(help="A scenario's id (`cosim list long-horizon`).")],
    output: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write the street, a .glb.")],
    suite: Annotated[
        str | None, typer.Option(help="Where the scenario is: a suite or a suite's .json file; by default looked up.")
    ] = None,
) -> None:
    """Write the street along a scenario's route as glTF: ground, buildings, trees, furniture, signals, barriers."""
    check_output(output, "glTF", (".glb",))
    from scenarios.catalog import holding, load_suite, scenarios_chosen
    from scenarios.viewing.export import export_street

    (one,) = scenarios_chosen(holding(scenario) if suite is None else load_suite(suite), [scenario])
    with doing("reading the scenario") as tell:
        tiles = export_street(one, output, tell)
    size = f"{tiles} tiles, {output.stat().st_size / 1e6:.1f} MB"
    out.print(f"Street: {output} ({one.id}, {size})", soft_wrap=True, highlight=False)


def check_rerun(path: Path | None, episodes: int) -> None:
    """Before anything runs, where a recording is asked for: raises UsageError for a name that is none, or several
    episodes, MachineError without the package."""
    if path is None:
        return
    check_output(path, "a Rerun recording", (".rrd",))
    if episodes != 1:
        how = "--scenario of `cosim run`, --episode of `cosim show`"
        raise UsageError(f"--rerun is of one episode, and {episodes or 'none'} are asked for: name one ({how})")
    if importlib.util.find_spec("rerun") is None:
        raise MachineError("--rerun needs rerun-sdk, of the extra [rerun]: pip install 'sidewalk-cosim[rerun]'")


def write_rerun(folder: Path, episodes: list[str], path: Path | None) -> None:
    """Write the recording of the one episode of a run, where it is asked for, and say so."""
    check_rerun(path, len(episodes))
    if path is None:
        return
    from scenarios.viewing.rerun_file import record_for_rerun

    with doing(f"recording {episodes[0]}") as tell:
        record_for_rerun(folder, episodes[0], path, tell=tell)
    size = f"{path.stat().st_size / 1e6:.1f} MB, the state hash is the record's"
    out.print(f"Recording: {path} ({size}). Open it with: rerun {path}", soft_wrap=True, highlight=False)


def view_of(name: str) -> Viewpoint:
    """The view called so. Raises UsageError with the valid names."""
    from scenarios.viewing.look import VIEWS

    for view in VIEWS:
        if view == name:
            return view
    raise unknown("view", name, VIEWS)


def size_of(text: str) -> tuple[int, int]:
    """Width and height in "1280x720". Raises UsageError."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 16 <= int(part) <= 4096 for part in parts):
        raise UsageError(f"--size '{text}': give width x height in pixels, each from 16 to 4096, like 1280x720")
    return int(parts[0]), int(parts[1])


def check_output(path: Path, what: str = "a picture", endings: tuple[str, ...] = PICTURES) -> None:
    """Before it is made: raises UsageError when no such file can have this name, MachineError without its folder."""
    if path.suffix.lower() not in endings:
        raise UsageError(f"{path}: cannot be written as {what}; use a name that ends in {' or '.join(endings[:2])}")
    if not path.resolve().parent.is_dir():
        raise MachineError(f"{path}: cannot be written: no folder {path.parent}")


def save(image: object, path: Path) -> None:
    """Write a picture. Raises MachineError when it cannot be written there."""
    import cv2
    import numpy as np

    try:
        written = cv2.imwrite(str(path), np.asarray(image)[..., ::-1])
    except cv2.error as error:
        raise UsageError(f"{path}: cannot be written as a picture; use a name that ends in .png or .jpg") from error
    if not written:
        raise MachineError(f"{path}: the picture cannot be written there")
