"""The commands `cosim collect` and `cosim dataset`."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from cosim.cli.console import err, out
from cosim.cli.options import (
    CAMERA_HELP,
    LEARN,
    ROBOT_HELP,
    Choice,
    camera_here,
    check_output,
    replaced,
    size_called,
)
from cosim.cli.progress import doing
from cosim.cli.run_progress import Board
from cosim.core.errors import INTERRUPTED, UsageError, unknown
from cosim.core.telling import Tell

if TYPE_CHECKING:
    from cosim.spec.scenario import Scenario, Suite
    from scenarios.suites.new_scenarios import Fresh


collect_app = typer.Typer()

_CITIES_HELP = (
    "Draw scenarios like the suite's (unit, reactive) in the generated cities of these seeds, "
    "which no suite uses."
)
_EVENT_HELP = (
    "Only scenarios of this event, with --cities also of this structure (straight, static); may "
    "be repeated."
)
_EPISODES_HELP = (
    "So many demonstrations are kept; of a suite all that are solved by default, else one of each."
)
_NOISE_HELP = (
    "Share of the time in which another command is driven, in bursts; the expert's answer is "
    "kept all the same."
)
_LEARNER_HELP = (
    "DAgger: this policy drives in --noise's share of the time, 1 to 5 s at once, and the "
    "expert's answer is kept. It sees the pictures that are collected."
)
_RATE_HELP = (
    "Pictures and answers a second: 1, 2, 4, 5, 10 or 20; of an expert that sees its own rate."
)
_UNSOLVED_HELP = "Keep also what the expert does not solve, up to where the robot is put back."


@collect_app.command(
    "collect",
    rich_help_panel=LEARN,
    epilog="Examples:  \n`cosim collect reactive --cities 900:940 --event gesturing --episodes "
    "500 --jobs 2 --out demos/gesturing`  \n`cosim collect unit --cities 900:980 --episodes 1000 "
    "--noise 0.2 --out demos/unit`  \n`cosim collect reactive --split val --policy my.py:Mine "
    "--camera 96x96 --rate 4 --out demos/val`  \n`cosim collect reactive --cities 900:940 --fov "
    "60 --noise 0.7 --learner small --unsolved --out demos/again`  \n`cosim collect ... --out "
    "demos/unit --resume`, where it was stopped; then `cosim dataset pack`",
)
def collect_command(
    suite: Annotated[
        str, typer.Argument(help="A suite (see `cosim list`) or the path of a suite's .json file.")
    ],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the data set.")],
    episodes: Annotated[int | None, typer.Option(min=1, help=_EPISODES_HELP)] = None,
    event: Annotated[list[str] | None, typer.Option(help=_EVENT_HELP)] = None,
    scenario: Annotated[
        list[str] | None, typer.Option(help="Only this scenario; may be repeated.")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only scenarios of val, or of test.")] = None,
    cities: Annotated[str, typer.Option(metavar="FIRST:END", help=_CITIES_HELP)] = "",
    city_size: Annotated[
        float, typer.Option(min=300.0, max=5000.0, help="Metres; of the cities of --cities.")
    ] = 2000.0,
    map_name: Annotated[
        str | None, typer.Option("--map", help="Draw on this place: a map, a folder, a net.")
    ] = None,
    policy: Annotated[
        str, typer.Option(help="The expert: a baseline, or your own as my.py:Class.")
    ] = "orca",
    robot: Annotated[str, typer.Option(help=ROBOT_HELP)] = "",
    size: Annotated[
        str, typer.Option("--camera", metavar="WxH", help="Pixels of the pictures.")
    ] = "160x90",
    fov: Annotated[
        float, typer.Option(min=1.0, max=170.0, help="Degrees from its lower to its upper edge.")
    ] = 75.0,
    mount: Annotated[str, typer.Option(help="Where the camera sits on the robot.")] = "front",
    rate: Annotated[float, typer.Option(help=_RATE_HELP)] = 5.0,
    goal: Annotated[
        str,
        typer.Option(
            help="What is told of where to go: none, route_point, final_point, instruction."
        ),
    ] = "route_point",
    waypoints: Annotated[
        int, typer.Option(help="So many places ahead are taken from the trajectory.")
    ] = 8,
    waypoint_s: Annotated[
        float, typer.Option("--waypoint-s", help="Seconds from one of them to the next.")
    ] = 0.2,
    noise: Annotated[float, typer.Option(help=_NOISE_HELP)] = 0.0,
    learner: Annotated[str, typer.Option(metavar="POLICY", help=_LEARNER_HELP)] = "",
    unsolved: Annotated[bool, typer.Option("--unsolved", help=_UNSOLVED_HELP)] = False,
    seed: Annotated[
        int, typer.Option(min=0, help="Of the policy, of noise, and with --map of the scenarios.")
    ] = 0,
    renderer: Annotated[
        Choice, typer.Option("--renderer", metavar="CAMERA", help=CAMERA_HELP)
    ] = "auto",
    own_camera: Annotated[
        bool, typer.Option("--own-camera", help="A camera that the robot does not have.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Environment processes.")] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the data set in --out.")
    ] = False,
) -> None:
    """Drive scenarios with an expert and write what it does and a camera sees as a LeRobot data set
    (v3.0).

    A row is a picture with speeds, goal, the expert's command, and waypoints from its trajectory.
    Only solved episodes are kept. The same command writes the same bytes, whatever --jobs; stopped
    at any moment it goes on with --resume.
    """
    from cosim.spec.camera import CameraSpec
    from cosim.spec.demo_options import Collecting
    from cosim.spec.goal import goal_called
    from cosim.spec.options import EpisodeOptions
    from cosim.spec.policy_host import PolicyHost
    from scenarios.episodes.demonstration import check_parquet

    check_parquet()  # before the modules that import pyarrow
    from scenarios.runs.policy_host import known_driver
    from scenarios.tools.dataset.collect import collect

    wide, high = size_called("--camera", size)
    spec = CameraSpec(width=wide, height=high, fov_deg=fov, mount=mount)
    collecting = Collecting(
        camera=spec,
        rate_hz=rate,
        waypoints=waypoints,
        waypoint_s=waypoint_s,
        noise=noise,
        learner=learner,
        unsolved=unsolved,
    )
    expert = known_driver(policy, PolicyHost(), jobs)
    options = EpisodeOptions(
        seed=seed,
        robot=robot,
        goal=goal_called(goal),
        own_camera=own_camera,
        camera=camera_here(renderer),
    )
    source = _source(
        suite,
        cities,
        city_size,
        map_name,
        event or (),
        scenario or (),
        split,
        episodes,
        seed,
        robot,
    )
    began_s = time.monotonic()
    try:
        found = collect(
            source,
            expert,
            policy,
            folder,
            collecting=collecting,
            options=options,
            episodes=episodes,
            jobs=jobs,
            resume=resume,
            showing=_shown,
            tell=_stages(),
        )
    except KeyboardInterrupt:
        again = shlex.join([*(word for word in sys.argv[1:] if word != "--resume"), "--resume"])
        err.print(
            f"Stopped. What is collected is kept in {folder}. Go on with: cosim {again}",
            soft_wrap=True,
        )
        raise typer.Exit(INTERRUPTED) from None
    out.print(
        f"Data set: {folder} ({found.kept} episodes, {found.rows} pictures, {_size_mb(folder):.1f} "
        f"MB), of {found.run} driven in {time.monotonic() - began_s:.0f} s",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    if found.dropped:
        reasons = "; ".join(f"{words}: {count}" for words, count in found.dropped.most_common())
        out.print(
            f"Dropped {found.dropped.total()} that were not solved: {reasons}",
            soft_wrap=True,
            highlight=False,
        )
    if found.spare:
        out.print(f"{found.spare} more were solved than asked for, and left out", highlight=False)
    if found.back is None:
        err.print("The data set was whole already: nothing is written.")
    else:
        back = found.back
        out.print(
            f"Read back: {back.rows} rows and pictures; a picture differs from what was "
            f"drawn for its row by "
            f"{back.off:.1f} of 255, from what was drawn for the next row by {back.off_next:.1f}",
            soft_wrap=True,
            highlight=False,
        )
    if episodes is not None and found.kept < episodes:
        err.print(f"There are no more: {episodes} were asked for.", highlight=False)


def _source(
    suite: str,
    cities: str,
    city_size: float,
    map_name: str | None,
    event: Sequence[str],
    scenario: Sequence[str],
    split: str | None,
    episodes: int | None,
    seed: int,
    robot: str,
) -> Suite | Fresh:
    """What is driven. Raises UsageError."""
    import msgspec

    from cosim.spec.robot import COURIER, robot_called
    from cosim.spec.scenario import Split
    from cosim.spec.selection import scenarios_chosen
    from scenarios.suites.catalog import load_suite, with_robot
    from scenarios.suites.new_scenarios import fresh, fresh_cities

    options = {"--cities": cities, "--map": map_name, "--scenario": scenario, "--split": split}
    told = [name for name, asked in options.items() if asked]
    if len(told) > 1 and (cities or map_name):
        raise UsageError(
            f"{' and '.join(told)} do not go together: scenarios are drawn in places, or are "
            f"a suite's"
        )
    if cities:
        return fresh(suite, fresh_cities(cities), event, city_size)
    if map_name is not None:
        from scenarios.suites.sample import suite_on_map

        with doing(f"drawing routes on {map_name}"):
            return suite_on_map(
                suite,
                map_name,
                seed,
                episodes,
                0.0,
                event,
                robot=robot_called(robot or COURIER.name),
            )
    if split not in (None, *get_args(Split)):
        raise unknown("split", str(split), get_args(Split))
    whole = with_robot(load_suite(suite), robot)
    return msgspec.structs.replace(
        whole, scenarios=scenarios_chosen(whole, scenario, None, event, split)
    )


@contextmanager
def _shown(scenarios: Sequence[Scenario], done: set[str]) -> Iterator[Callable[[object], None]]:
    board = Board(scenarios, done)
    with board.bars:
        yield board.tell


def _stages() -> Tell:
    """Says a stage in a line when it begins; what moves in a terminal is the board alone."""
    said = ""

    def tell(stage: str, share: float | None = None, /) -> None:
        nonlocal said
        if stage != said:
            said = stage
            err.print(f"{stage} ...", soft_wrap=True, markup=False, highlight=False)

    return tell


def _size_mb(folder: Path) -> float:
    parts = [path for name in ("meta", "data", "videos") for path in (folder / name).rglob("*")]
    return sum(path.stat().st_size for path in parts if path.is_file()) / 1e6


dataset_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="What `cosim collect` has made, for training.",
)


@dataset_app.command(
    "pack",
    epilog="Examples:  \n`cosim dataset pack demos/unit -o unit.npz`  \n"
    "`cosim dataset pack demos/unit demos/gesturing -o both.npz --size 96x96`",
)
def pack(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Data sets, one after another.")
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FILE", help="Where to write the arrays, a .npz."),
    ],
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Pixels of the pictures, in place of their own.")
    ] = "",
) -> None:
    """Write data sets as plain arrays: pictures, speeds, goals, commands, waypoints, for who has
    numpy alone.

    The arrays are told in `cosim/core/packed_demos.py`; `cosim.core.packed_demos.read_packed` reads
    them.
    """
    from scenarios.episodes.demonstration import check_parquet

    check_parquet()
    check_output(output, "packed arrays", (".npz",))
    wanted = size_called("--size", size) if size else None
    from scenarios.tools.dataset.read import packed_sets

    instead = replaced(output)
    with doing("reading the rows") as tell:
        packed = packed_sets(folders, wanted, tell)
        tell("writing the arrays")
        packed.save(output)
    shape = " x ".join(map(str, packed.frames.shape))
    out.print(
        f"Packed: {output} ({len(packed.meta['scenarios'])} episodes, pictures {shape}, "
        f"{output.stat().st_size / 1e6:.1f} MB){instead}",
        soft_wrap=True,
        highlight=False,
    )
