"""The commands `cosim collect` and `cosim dataset`."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli.console import err, out, say
from cosim.cli.generated_options import ConfiguredCommand, Fields, configured
from cosim.cli.options import LEARN, camera_here, check_output, parse_size, replacement_note
from cosim.cli.progress import doing, stages_in_lines
from cosim.cli.run_progress import ProgressDisplay
from cosim.core.errors import INTERRUPTED, TIME_IS_UP, UsageError
from cosim.spec.run_config import DataFormat, Option, RunConfig

if TYPE_CHECKING:
    from cosim.spec.demo_options import DemoOptions
    from cosim.spec.scenario import Scenario, Suite
    from scenarios.suites.new_scenarios import NewScenarios
    from scenarios.tools.dataset.collect import CollectResult


collect_app = typer.Typer()

_EPISODES_HELP = (
    "Number of demonstrations; default: of a suite all that are solved, else one of each."
)
_EVENT_HELP = (
    "Only scenarios of this event, with --cities also of this structure (straight, static); may "
    "be repeated."
)
_OF_COLLECT = Fields(
    only=(
        "suite",
        "out",
        "episodes",
        "event",
        "scenario",
        "split",
        "no_decoys",
        "map",
        "policy",
        "isolated",
        "policy_data",
        "policy_memory",
        "robot",
        "weather",
        "goal",
        "seed",
        "camera",
        "appearance",
        "own_camera",
        "jobs",
        "resume",
    ),
    help={
        "out": "Folder of the data set.",
        "episodes": _EPISODES_HELP,
        "event": _EVENT_HELP,
        "scenario": "Only this scenario; may be repeated.",
        "split": "Only scenarios of val, or of test.",
        "no_decoys": "Leave out the decoys of a suite.",
        "map": "Draw on this place: a map, a folder, a net.",
        "policy": "The expert: a baseline, or your own as my.py:Class.",
        "goal": "Goal protocol: none, route_point, final_point, instruction.",
        "seed": "Of the policy, of noise, and with --map of the scenarios.",
        "own_camera": "A camera that the robot does not have.",
        "jobs": "Environment processes.",
        "resume": "Continue the data set in --out.",
    },
    default={"policy": "orca", "goal": "route_point", "seed": 0, "jobs": 1},
    flag={"camera": "--renderer"},
    required=("out",),
)
"""Options that `cosim collect` shares with `cosim run`."""


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """Options of `cosim collect` for recorded data and for the places of scenarios."""

    cities: Annotated[
        str,
        Option(
            "Draw scenarios like the suite's (unit, reactive) in the generated cities of these "
            "seeds, which no suite uses.",
            metavar="FIRST:END",
        ),
    ] = ""
    city_size: Annotated[
        float, Option("Metres; of the cities of --cities.", least=300.0, most=5000.0)
    ] = 2000.0
    size: Annotated[
        str,
        Option(
            "Pixels of the pictures; the network sidewalk needs 320x180.",
            flag="--camera",
            metavar="WxH",
        ),
    ] = "160x90"
    fov: Annotated[
        float, Option("Degrees from its lower to its upper edge.", least=1.0, most=170.0)
    ] = 75.0
    mount: Annotated[str, Option("Where the camera sits on the robot.")] = "front"
    rate: Annotated[
        float,
        Option(
            "Pictures and answers a second: 1, 2, 4, 5, 10 or 20; of an expert that sees its "
            "own rate."
        ),
    ] = 5.0
    waypoints: Annotated[int, Option("Number of waypoints from the trajectory.")] = 8
    waypoint_s: Annotated[float, Option("Seconds between waypoints.")] = 0.2
    noise: Annotated[
        float,
        Option(
            "Share of the time in which another command is driven, in bursts; the expert's "
            "answer is stored."
        ),
    ] = 0.0
    learner: Annotated[
        str,
        Option(
            "DAgger: this policy drives in --noise's share of the time, 1 to 5 s at once, and the "
            "expert's answer is stored. It sees the pictures that are collected.",
            metavar="POLICY",
        ),
    ] = ""
    explore: Annotated[
        float,
        Option(
            "The learner drives alone, and rows have its commands and rewards, for `cosim train "
            "--values`; they are changed at random in this share of the time."
        ),
    ] = 0.0
    unsolved: Annotated[
        bool, Option("Store unsolved episodes, too, up to where the robot is put back.")
    ] = False
    labels: Annotated[
        bool,
        Option("Store people, free ground, signals and events ahead, for auxiliary heads."),
    ] = False
    decoys: Annotated[bool, Option("With --cities, draw the decoy of each event, too.")] = False
    astray: Annotated[
        float,
        Option(
            "Share of the episodes that begin aside of the route, turned away from it.",
            least=0.0,
            most=1.0,
        ),
    ] = 0.0
    weathers: Annotated[
        str,
        Option("Draw the weather of each episode from these.", metavar="NAME,NAME..."),
    ] = ""
    minutes: Annotated[
        float,
        Option(
            "Begin no episode after so long, and end with exit code 4: --resume continues.",
            default="no limit",
            least=0.0,
        ),
    ] = math.inf
    format: Annotated[
        DataFormat,
        Option(
            "A LeRobot data set, a ROS 2 bag of each episode (package extra [ros2]), or raw "
            "demonstrations, which `cosim dataset pack` reads: faster for thousands."
        ),
    ] = "lerobot"

    lidar: Annotated[
        int, Option("Rays of a lidar that is stored, too; 0 for none.", metavar="RAYS")
    ] = 0
    imu: Annotated[str, Option("Inertial sensor that is stored: none, exact, noisy.")] = "none"
    people: Annotated[str, Option("Tracked people that are stored: none, seen.")] = "none"

    @property
    def collecting(self) -> DemoOptions:
        """Settings of the recorded data. Raises UsageError, SpecError."""
        from cosim.spec.camera import CameraSpec
        from cosim.spec.demo_options import DemoOptions
        from cosim.spec.sensors import ScanSpec, imu_called, people_called

        wide, high = parse_size("--camera", self.size)
        return DemoOptions(
            camera=CameraSpec(width=wide, height=high, fov_deg=self.fov, mount=self.mount),
            rate_hz=self.rate,
            waypoints=self.waypoints,
            waypoint_s=self.waypoint_s,
            noise=self.noise,
            learner=self.learner,
            explore=self.explore,
            unsolved=self.unsolved,
            format=self.format,
            scan=ScanSpec(rays=self.lidar) if self.lidar else None,
            imu=imu_called(self.imu),
            people=people_called(self.people),
            labels=self.labels,
            astray=self.astray,
            weathers=tuple(filter(None, self.weathers.split(","))),
        )


@collect_app.command(
    "collect",
    cls=ConfiguredCommand,
    rich_help_panel=LEARN,
    epilog="Examples:  \n`cosim collect reactive --cities 900:940 --event gesturing --episodes "
    "500 --jobs 2 --out demos/gesturing`  \n`cosim collect unit --cities 900:980 --episodes 1000 "
    "--noise 0.2 --out demos/unit`  \n`cosim collect reactive --split val --policy my.py:Mine "
    "--camera 96x96 --rate 4 --out demos/val`  \n`cosim collect reactive --cities 900:940 --fov "
    "60 --noise 0.7 --learner small --unsolved --out demos/again`  \n`cosim collect ... --out "
    "demos/unit --resume`, where it was stopped; then `cosim dataset pack`",
)
@configured
def collect_command(
    config: Annotated[RunConfig, _OF_COLLECT],
    demo: Annotated[DemoConfig, Fields()],
) -> None:
    """Drive scenarios with an expert, and write a LeRobot data set (v3.0).

    A row is a picture with speeds, goal, the expert's command, and waypoints from its trajectory.
    Only solved episodes are stored. The bytes are the same for any --jobs. A stopped collection
    continues with --resume.
    """
    from scenarios.episodes.demonstration import check_parquet

    if demo.format != "raw":
        check_parquet()
    from cosim.spec.options import EpisodeOptions
    from scenarios.runs.policy_host import host_of, inspected_caller
    from scenarios.tools.dataset.collect import collect

    folder = config.out
    jobs = config.jobs or 1
    assert folder is not None
    if config.ros2 is not None and jobs > 1:
        raise UsageError(f"policy '{config.policy}' drives one episode at a time here: one job")
    collecting = demo.collecting
    host = host_of(config)
    expert = inspected_caller(config.policy, host, jobs)
    options = EpisodeOptions.from_config(replace(config, camera=camera_here(config.camera)))
    source = _source(config, demo)
    began_s = time.monotonic()
    try:
        found = collect(
            source,
            expert,
            config.policy,
            folder,
            collecting=collecting,
            options=options,
            episodes=config.episodes,
            jobs=jobs,
            host=host,
            resume=config.resume,
            minutes=demo.minutes,
            showing=_show_board,
            progress=stages_in_lines(),
        )
    except KeyboardInterrupt:
        _print_stopped("Stopped", folder)
        raise typer.Exit(INTERRUPTED) from None
    if not found.whole:
        _print_stopped(f"The time is up after {found.stored} episodes", folder)
        raise typer.Exit(TIME_IS_UP)
    _print_end(found, folder, time.monotonic() - began_s)
    if config.episodes is not None and found.stored < config.episodes:
        err.print(f"There are no more: {config.episodes} were requested.", highlight=False)


def _print_stopped(why: str, folder: Path) -> None:
    """Print how a collection continues that was stopped."""
    again = shlex.join([*(word for word in sys.argv[1:] if word != "--resume"), "--resume"])
    err.print(
        f"{why}. Collected episodes are stored in {folder}. Continue with: cosim {again}",
        soft_wrap=True,
    )


def _print_end(found: CollectResult, folder: Path, took_s: float) -> None:
    """Print the numbers of collected and dropped episodes, and the result of reading them back."""
    pictures = f"{found.rows} pictures, " if found.rows else ""
    kept = f"{found.stored} episodes, {pictures}{_size_mb(folder):.1f} MB"
    words = f"Data set: {folder} ({kept}), of {found.run} driven in {took_s:.0f} s"
    say(words)
    if found.dropped:
        reasons = "; ".join(f"{words}: {count}" for words, count in found.dropped.most_common())
        out.print(
            f"Dropped {found.dropped.total()} that were not solved: {reasons}",
            soft_wrap=True,
            highlight=False,
        )
    if found.spare:
        out.print(f"{found.spare} more were solved than requested, and left out", highlight=False)
    if found.form == "raw":
        out.print(f"Arrays: cosim dataset pack {folder} -o FILE.npz", highlight=False)
        return
    if found.form == "rosbag2":
        out.print(f"Bags: {folder / 'bags'}, one for each episode", highlight=False)
        return
    if (back := found.back) is None:
        err.print("The data set was complete already: nothing is written.")
        return
    words = (
        f"Read back: {back.rows} rows and pictures; a picture differs from what was drawn for its "
        f"row by {back.off:.1f} of 255, from what was drawn for the next row by {back.off_next:.1f}"
    )
    out.print(words, soft_wrap=True, highlight=False)


def _source(config: RunConfig, demo: DemoConfig) -> Suite | NewScenarios:
    """Return the suite or the source of new scenarios to drive. Raises UsageError."""
    import msgspec

    from cosim.spec.robot import COURIER, robot_called
    from cosim.spec.scenario import split_called
    from cosim.spec.selection import select_scenarios
    from scenarios.suites.catalog import load_suite
    from scenarios.suites.new_scenarios import new_cities, new_scenarios

    options = {
        "--cities": demo.cities,
        "--map": config.map,
        "--scenario": config.scenario,
        "--split": config.split,
    }
    given = [name for name, value in options.items() if value]
    if len(given) > 1 and (demo.cities or config.map):
        raise UsageError(
            f"{' and '.join(given)} do not go together: scenarios are drawn in places, or are "
            f"a suite's"
        )
    if demo.weathers and config.weather:
        raise UsageError("--weathers and --weather do not go together: give one of them")
    if demo.cities:
        if demo.decoys and config.suite != "reactive":
            raise UsageError(
                f"--decoys goes with reactive: new scenarios of {config.suite} have no decoys"
            )
        cities = new_cities(demo.cities)
        return new_scenarios(config.suite, cities, config.event, demo.city_size, demo.decoys)
    if demo.decoys:
        raise UsageError("--decoys goes with --cities: a suite has its own, see --no-decoys")
    if config.map is not None:
        from scenarios.suites.sample import suite_on_map

        robot = robot_called(config.robot or COURIER.name)
        with doing(f"drawing routes on {config.map}"):
            seed = config.seed or 0
            return suite_on_map(
                config.suite, config.map, seed, config.episodes, 0.0, config.event, robot=robot
            )
    split = split_called(config.split)
    whole = load_suite(config.suite)
    chosen = select_scenarios(
        whole, config.scenario, None, config.event, split, decoys=not config.no_decoys
    )
    return msgspec.structs.replace(whole, scenarios=chosen)


@contextmanager
def _show_board(
    scenarios: Sequence[Scenario], done: set[str]
) -> Iterator[Callable[[object], None]]:
    board = ProgressDisplay(scenarios, done)
    with board.bars:
        yield board.tell


def _size_mb(folder: Path) -> float:
    names = ("runs",) if (folder / "about.json").exists() else ("meta", "data", "videos", "bags")
    parts = [path for name in names for path in (folder / name).rglob("*")]
    return sum(path.stat().st_size for path in parts if path.is_file()) / 1e6


dataset_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Data sets of `cosim collect`, for training.",
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
    part: Annotated[
        int, typer.Option(min=1, help="Episodes in a file, for collections of --format raw.")
    ] = 250,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that pack such collections.")] = 1,
) -> None:
    """Write data sets as plain arrays, which need numpy only.

    `cosim/core/packed_demos.py` describes the arrays, and its `read_packed` reads them.
    Collections of --format raw, finished or not, are written in parts: NAME-000.npz and so on.
    """
    check_output(output, "packed arrays", (".npz",))
    wanted = parse_size("--size", size) if size else None
    from scenarios.tools.dataset.pack import is_raw, pack_raw

    if is_raw(folders[0]):
        with doing("packing the episodes") as progress:
            parts = pack_raw(folders, output, wanted, part=part, jobs=jobs, progress=progress)
        episodes, rows = sum(one.episodes for one in parts), sum(one.rows for one in parts)
        size_mb = sum(one.path.stat().st_size for one in parts) / 1e6
        out.print(
            f"Packed: {parts[0].path} to {parts[-1].path.name} ({episodes} episodes, {rows} "
            f"pictures, {size_mb:.1f} MB)",
            soft_wrap=True,
            highlight=False,
        )
        return
    from scenarios.episodes.demonstration import check_parquet

    check_parquet()
    from scenarios.tools.dataset.read import packed_sets

    instead = replacement_note(output)
    with doing("reading the rows") as progress:
        packed = packed_sets(folders, wanted, progress)
        progress("writing the arrays")
        packed.save(output)
    shape = " x ".join(map(str, packed.frames.shape))
    out.print(
        f"Packed: {output} ({len(packed.meta['scenarios'])} episodes, pictures {shape}, "
        f"{output.stat().st_size / 1e6:.1f} MB){instead}",
        soft_wrap=True,
        highlight=False,
    )
