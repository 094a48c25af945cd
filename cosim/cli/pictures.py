"""The commands `cosim look`, `film`, `export`, `replay` and `counterfactual`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli import tables
from cosim.cli.console import out
from cosim.cli.options import (
    LOOK,
    Appears,
    Camera,
    camera_here,
    check_output,
    parse_size,
    replacement_note,
)
from cosim.cli.progress import doing
from cosim.core.errors import MachineError, UsageError, listed, unknown
from cosim.spec.run_config import Appearance, help_of

if TYPE_CHECKING:
    from cosim.spec.scenario import Suite
    from scenarios.tools.viewing.look import Viewpoint


export_app = typer.Typer()


@export_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim export lh-011-00 street.glb`  \n"
    "`cosim export lh-011-00 street.glb --run runs/mine --at 20`",
)
def export(
    scenario: Annotated[str, typer.Argument(help="A scenario's id (`cosim list long-horizon`).")],
    output: Annotated[
        Path, typer.Argument(metavar="FILE", help="Where to write the street, a .glb.")
    ],
    suite: Annotated[
        str | None,
        typer.Option(
            help="Where the scenario is: a suite or a suite's .json file; by default looked up."
        ),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A run folder with the scenario, in place of a suite."),
    ] = None,
    at: Annotated[
        float, typer.Option(min=0.0, help="With --run: the robot as it was after these seconds.")
    ] = 0.0,
) -> None:
    """Export the street along a scenario's route as glTF: buildings, trees, furniture, robot."""
    check_output(output, "glTF", (".glb",))
    if run is None and at:
        raise UsageError("--at needs --run RUN: the robot is at its start otherwise")
    if run is not None and suite is not None:
        raise UsageError("--run and --suite both say where the scenario is: give one of them")
    from scenarios.tools.viewing.export import export_street, recorded_robot

    instead = replacement_note(output)
    with doing("reading the scenario") as progress:
        if run is None:
            from cosim.spec.selection import select_scenarios
            from scenarios.suites.catalog import load_suite, suite_with_scenario

            found = suite_with_scenario(scenario) if suite is None else load_suite(suite)
            (one,), robot = select_scenarios(found, [scenario]), None
        else:
            one, robot = recorded_robot(run, scenario, at)
        tiles = export_street(one, output, robot, progress)
    size = f"{tiles} tiles, {output.stat().st_size / 1e6:.1f} MB"
    out.print(f"Street: {output} ({one.id}, {size}){instead}", soft_wrap=True, highlight=False)


def view_of(name: str) -> Viewpoint:
    """Return the view with a name. Raises UsageError with the valid names."""
    from scenarios.tools.viewing.look import VIEWS

    for view in VIEWS:
        if view == name:
            return view
    raise unknown("view", name, VIEWS)


film_app = typer.Typer()


@film_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim film runs/mine lh-011-00 --from 30 --to 60 -o film.mp4`  \n"
    "`cosim film runs/mine --failure --view above`",
)
def film(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[
        str | None,
        typer.Argument(
            help="One of its episodes; with --failure by default the first that failed."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Where to write the film, an .mp4.")
    ] = Path("film.mp4"),
    failure: Annotated[
        bool,
        typer.Option("--failure", help="Film the first failure: 10 s before it to 2 s after it."),
    ] = False,
    start: Annotated[
        float | None,
        typer.Option(
            "--from",
            min=0.0,
            help="First second of the episode.",
            show_default="0, or as --failure says",
        ),
    ] = None,
    end: Annotated[
        float | None,
        typer.Option(
            "--to", help="Last second of the episode.", show_default="the end, or as --failure says"
        ),
    ] = None,
    size: Annotated[str, typer.Option(help="Width x height in pixels, both even.")] = "1280x720",
    view: Annotated[
        str, typer.Option(help="follow (from behind), above, or robot: what it sees.")
    ] = "follow",
    speed: Annotated[int, typer.Option(min=1, max=32, help="Times real time.")] = 1,
    camera: Camera = "auto",
    appearance: Annotated[
        Appearance | None,
        typer.Option("--appearance", help="Look of a scanned place. Default: the run's."),
    ] = None,
) -> None:
    """Film an episode of a run from behind or above, with camera picture, map and failures."""
    from scenarios.tools.viewing.film import Cut, failure_to_film, make_film

    picked = view_of(view)
    from_s = 0.0
    until_s = math.inf
    if failure:
        shown = failure_to_film(folder, episode)
        episode, from_s, until_s = shown.scenario, shown.from_s, shown.to_s
        out.print(
            f"Failure: {episode}, {shown.at_s:.1f} s: {shown.reason}",
            soft_wrap=True,
            highlight=False,
        )
    if episode is None:
        raise UsageError(
            f"{folder}: name one of its episodes, or give --failure: {_episodes(folder)}"
        )
    from_s, until_s = from_s if start is None else start, until_s if end is None else end
    instead = replacement_note(output)
    with doing("choosing the camera") as progress:
        cut = Cut(
            from_s,
            until_s,
            parse_size("--size", size, (16, 4096)),
            speed,
            camera_here(camera),
            picked,
            appearance,
        )
        to_s = make_film(folder, episode, output, cut, progress)
    same = (
        "the state hash is the record's"
        if to_s == math.inf
        else f"of its first {to_s:g} s every tick is as recorded"
    )
    out.print(f"Film: {output} ({same}){instead}", soft_wrap=True, highlight=False)


def _episodes(folder: Path) -> str:
    """List the finished episodes of a run."""
    from cosim.results.run_folder import read_records

    return listed("", [record.scenario.id for record in read_records(folder)])


look_app = typer.Typer()


@look_app.command(
    rich_help_panel=LOOK,
    epilog="Examples:  \n`cosim look lh-011-00 --at 20 -o frame.png`  \n`cosim look lh-011-00 "
    "--residents 8`  \n`cosim look mine.toml --scenario 2 --view above`  \n`cosim look "
    "reactive --scenario 3`  \n`cosim look frontal-sumo-fkk-in-000 --map sumo-fkk-in`",
)
def look(
    scenario: Annotated[
        str,
        typer.Argument(
            help="A scenario's id (`cosim list long-horizon`), a suite, or a file: your .toml, a "
            "suite's .json, or a run folder."
        ),
    ],
    which: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            help="Of a suite, file or run, which scenario: its id or its number; by default the "
            "first.",
        ),
    ] = None,
    at: Annotated[float, typer.Option(min=0.0, help="Seconds into the episode.")] = 0.0,
    view: Annotated[str, typer.Option(help="robot, follow (from behind) or above.")] = "robot",
    size: Annotated[str, typer.Option(help="Width x height in pixels.")] = "1280x720",
    suite: Annotated[
        str | None,
        typer.Option(
            help="Where the scenario is: a suite or a suite's .json file; by default looked up."
        ),
    ] = None,
    drawn_on: Annotated[
        str | None,
        typer.Option("--map", help="Map on which `cosim run --map` drew the scenario."),
    ] = None,
    policy: Annotated[str, typer.Option(help="The policy that drives until then.")] = "route",
    robot: Annotated[str, typer.Option(help=help_of("robot"))] = "",
    weather: Annotated[str, typer.Option(help=help_of("weather"))] = "",
    residents: Annotated[int | None, typer.Option(min=0, help=help_of("residents"))] = None,
    groups: Annotated[float | None, typer.Option(help=help_of("groups"))] = None,
    elderly: Annotated[float | None, typer.Option(help=help_of("elderly"))] = None,
    children: Annotated[float | None, typer.Option(help=help_of("children"))] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Where to write the picture.")
    ] = Path("look.png"),
    camera: Camera = "auto",
    appearance: Appears = "splats",
) -> None:
    """Draw one picture of a scenario: by the robot's camera, from behind or from above."""
    from scenarios.suites.catalog import one_scenario, with_crowd, with_robot, with_weather
    from scenarios.tools.viewing.look import look_at

    picked = view_of(view)
    pixels = parse_size("--size", size, (16, 4096))
    check_output(output)
    if drawn_on is None:
        found, of = one_scenario(scenario, suite, which)
    else:
        found, of = _drawn(scenario, drawn_on, robot, suite or which), 1
    changed = with_crowd(
        with_weather(with_robot(found, robot), weather),
        residents=residents,
        groups=groups,
        elderly=elderly,
        children=children,
    )
    (one,) = changed.scenarios
    more = "" if which or of == 1 else f"; 1 of {of} scenarios: --scenario chooses another"
    with doing("choosing the camera") as progress:
        drawn_by = camera_here(camera)
        image, time_s = look_at(one, policy, at, picked, pixels, drawn_by, progress, appearance)
    instead = replacement_note(output)
    _save(image, output)
    out.print(
        f"Picture: {output} ({one.id} at {time_s:.2f} s, {view}{more}){instead}",
        soft_wrap=True,
        highlight=False,
    )


def _drawn(scenario: str, map_name: str, robot: str, chosen: str | None) -> Suite:
    """Return the suite with a scenario that `cosim run --map` draws. Raises UsageError."""
    from cosim.spec.robot import COURIER, robot_called
    from scenarios.suites.sample import drawn_on_map

    if chosen is not None:
        raise UsageError("--map draws the scenario again: leave --suite and --scenario out")
    with doing(f"drawing {scenario}"):
        return drawn_on_map(scenario, map_name, robot_called(robot or COURIER.name))


def _save(image: object, path: Path) -> None:
    """Write a picture. Raises UsageError for its format, MachineError if it cannot be written."""
    import cv2
    import numpy as np

    try:
        written = cv2.imwrite(str(path), np.asarray(image)[..., ::-1])
    except cv2.error as error:
        raise UsageError(
            f"{path}: cannot be written as a picture; use a name that ends in .png or .jpg"
        ) from error
    if not written:
        raise MachineError(f"{path}: the picture cannot be written there")


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
    """Simulate an episode's street again without the robot, and print the delays it caused."""
    from cosim.results.delay import DELAY_NEAR_M
    from scenarios.episodes.replay import check_state_hash, load_recorded, replay_and_compare

    with doing(f"reading {episode}") as progress:
        record = load_recorded(folder, episode)
        state_hash, found = replay_and_compare(record, progress)
    check_state_hash(folder, record, state_hash)
    rows = []
    for name, delay in (("people", found.people), ("vehicles", found.vehicles)):
        near = (f"{delay.near_s:+.1f}", str(delay.near))
        everyone = (f"{delay.delay_s:+.1f}", str(delay.compared))
        rows.append((name, *near, *everyone, str(delay.unmatched)))
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
    """Run a finished episode again from its record, and compare the state hash."""
    from scenarios.episodes.replay import check_state_hash, load_recorded, replay_state_hash

    with doing(f"reading {episode}") as progress:
        record = load_recorded(folder, episode)
        again = replay_state_hash(record, progress=progress)
    check_state_hash(folder, record, again)
    out.print(f"{episode}: state hash {again}, as recorded", highlight=False)
