"""The command `cosim bench`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli import tables
from cosim.cli.console import out, say
from cosim.cli.exploit import bench_cheats, bench_exploit
from cosim.cli.legs import bench_legs
from cosim.cli.options import MEASURE
from cosim.cli.people import bench_people
from cosim.cli.progress import doing
from cosim.core.errors import UsageError, unknown
from cosim.spec.run_config import Appearance, help_of

if TYPE_CHECKING:
    from scenarios.tools.bench.figures import Figure


_SHARE = [*tables.figures("count"), *tables.labels("of"), *tables.figures("share", "target")]
"""Columns of a table of shares."""

LIGHTS = (
    ("persons entered at red", "persons entered signalised crossings", "0"),
    ("persons entered within a second of red", "persons entered signalised crossings", ""),
    ("vehicles passed at red", "vehicles passed stop lines", "0"),
    ("vehicles passed within a second of red", "vehicles passed stop lines", ""),
    ("vehicles passed at yellow", "vehicles passed stop lines", ""),
    ("vehicles passed at green", "vehicles passed stop lines", ""),
)

SHARES = (
    ("overlaps", "pairs in contact range", "< 0.1 %"),
    ("pairs nearer than 0.45 m", "pairs in contact range", ""),
    ("pairs nearer than 0.6 m", "pairs in contact range", ""),
    ("within 0.15 m of a thing", "persons", ""),
    ("in a building", "persons", "0"),
    ("in a thing in the clear band", "persons", "0"),
    ("in a vehicle", "persons", "0"),
    ("off the walkable area", "persons", ""),
    *LIGHTS,
)
"""Rows of the crowd's table: counted event, its total, target."""


def bench_crowd(
    cities: int, minutes: float, residents: int, groups: float, elderly: float, children: float
) -> None:
    """Simulate the crowd of several cities, and print overlaps and violations of signals."""
    from cosim.spec.scenario import CrowdSpec
    from scenarios.tools.bench.crowd import APART_M, measure_crowds, summed

    spec = CrowdSpec(residents=residents, groups=groups, elderly=elderly, children=children)
    with doing("simulating the crowd") as progress:
        found = measure_crowds(cities, minutes, spec, progress)
    counts = summed(one.counts for one in found)
    total_min = sum(one.minutes for one in found)
    places = (
        f"{len(found)} cities, {total_min:.0f} min, {sum(f.crossings for f in found)} signalised "
        f"crossings entered"
    )
    rows = _shares(SHARES, counts)
    shown = {name for name, whole, _ in SHARES for name in (name, whole)}
    for name in sorted(counts.keys() - shown):
        rows.append((name, f"{counts[name]:.2f}", "", "", ""))
    tables.show(out, [*tables.names(places), *_SHARE], rows)
    out.print("People and pairs are counted in seconds, entries and vehicles one by one.")
    each = []
    for one in found:
        overlaps = one.counts.get("overlaps", 0.0) / max(
            one.counts.get("pairs in contact range", 0.0), 1e-9
        )
        numbers = (
            f"{one.minutes:.0f}",
            f"{one.persons:.0f}",
            f"{100 * overlaps:.4f} %",
            f"{one.crowd_ms:.2f}",
        )
        each.append((one.place, *numbers))
    heads = ("min", "persons", "overlaps, share of pair-seconds", "crowd's step, CPU ms")
    tables.show(out, [*tables.names("city"), *tables.figures(*heads)], each)
    if gaps_m := sorted(gap for one in found for gap in one.group_gaps_m):
        middle, most = (gaps_m[int(share * len(gaps_m))] for share in (0.5, 0.95))
        apart = sum(gap > APART_M for gap in gaps_m) / len(gaps_m)
        out.print(
            f"Groups, largest distance of a member to its nearest other: median {middle:.2f} m, "
            f"95 % within {most:.2f} m, beyond {APART_M:g} m {100 * apart:.2f} % of the time."
        )


def bench_crossings(crossings: int, cities: int, policy: str, jobs: int) -> None:
    """Drive a policy over signalised crossings, and print violations of signals by all."""
    from scenarios.tools.bench.crossings import cross_all, crossings_entered
    from scenarios.tools.bench.crowd import summed

    with doing("drawing crossings") as progress:
        rows = cross_all(crossings, cities, policy, jobs, progress)
    places = (
        f"cities: {len({row.city for row in rows})}, minutes: "
        f"{sum(row.minutes for row in rows):.0f}"
    )
    robot = []
    waited = [row.waited_s for row in rows if row.waited_s > 0.0]
    for name, rows_with in (
        ("reached the goal", [row for row in rows if row.ended == "goal"]),
        ("entered at red", [row for row in rows if row.red_entries]),
        ("failed", [row for row in rows if row.failures]),
        ("made vehicles brake", [row for row in rows if row.vehicles_braked]),
        ("crashed", [row for row in rows if row.ended == "crashed"]),
    ):
        named = ", ".join(
            f"{row.scenario or row.city} {row.reason}{', '.join(row.failures)}" for row in rows_with
        )
        robot.append((name, str(len(rows_with)), "" if name == "reached the goal" else named))
    mean = f"{sum(waited) / len(waited):.1f} s each on the mean" if waited else ""
    robot.append(("waited at red", str(len(waited)), mean))
    on_road_s = sum(row.carriageway_s for row in rows)
    robot.append(("on the carriageway, or on a crossing at red", f"{on_road_s:.1f} s", ""))
    columns = [
        *tables.names(policy),
        *tables.figures(""),
        *tables.words(f"signalised crossings: {len(rows)}, {places}"),
    ]
    tables.show(out, columns, robot)
    counts = summed(row.counts for row in rows)
    lights = _shares(LIGHTS, counts)
    for name in ("vehicles drove over a crossing at walk", "vehicles within 1 m of a walker on it"):
        lights.append((name, f"{counts.get(name, 0.0):.2f}", "", "", ""))
    first = tables.names(f"crowd and vehicles, {crossings_entered(rows)} crossings entered")
    tables.show(out, [*first, *_SHARE], lights)
    for row in rows:
        for entry in row.at_red:
            say(f"{row.scenario}: {entry}")


def _shares(
    shares: tuple[tuple[str, str, str], ...], counts: Mapping[str, float]
) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, whole, target in shares:
        count, of = counts.get(name, 0.0), counts.get(whole, 0.0)
        share = f"{100.0 * count / of:.4f} %" if of else ""
        rows.append((name, f"{count:.2f}", f"{of:.0f} {whole}", share, target))
    return rows


def bench_realism(
    places: Sequence[str],
    splits: Sequence[str],
    weathers: Sequence[str],
    frames: int,
    appearance: Appearance,
    weights: Path | None,
    folder: Path | None,
    before: Path | None,
) -> None:
    """Compare what networks see in pictures with the labels, and print the shares.

    before: realism.json of another run, whose figures are shown in columns of their own.
    """
    from cosim.spec.scenario import split_called
    from cosim.spec.weather import CLEAR, weather_called
    from scenarios.tools.bench.realism import (
        as_json,
        called,
        figures_of,
        measure_realism,
        read_realism,
    )

    named = [one for one in map(split_called, splits) if one is not None]
    skies = [weather_called(one).name for one in weathers]
    if weights is not None and not weights.is_dir():
        raise UsageError(f"--weights {weights}: no folder; give the one with the networks' files")
    earlier = [] if before is None else read_realism(before)
    with doing("driving") as progress:
        found = measure_realism(
            places or ("",), named, skies, frames, appearance, weights, folder, progress
        )
    columns = {
        f"{called(one['place'], one['split'], one.get('weather', CLEAR))}, before": figures_of(one)
        for one in earlier
    }
    columns |= {one.called: figures_of(as_json(one)) for one in found}
    names = dict.fromkeys(name for figures in columns.values() for name in figures)
    rows = [(name, *(figures.get(name, "") for figures in columns.values())) for name in names]
    tables.show(out, [*tables.names(""), *tables.figures(*columns)], rows)
    if folder is not None:
        out.print(f"Pictures with boxes, and realism.json: {folder}", highlight=False)


bench_app = typer.Typer()
NO_FIGURE = ("none: see below", "")
_SEVERAL = "Options of several measurements"
_SPEED, _CROWD, _CROSSINGS, _EXPLOIT, _REALISM, _LEGS = (
    f"Options of {name}"
    for name in ("environment and camera", "crowd", "crossings", "exploit", "realism", "legs")
)


@bench_app.command(
    rich_help_panel=MEASURE,
    epilog="Examples:  \n`cosim bench --rounds 5`  \n`cosim bench --only driving --compare "
    "../cosim-before`  \n`cosim bench camera`  \n`cosim bench crowd --cities 10`  \n`cosim bench "
    "crossings --crossings 40 --jobs 2 --policy orca`  \n`cosim bench exploit --kinds lateral "
    "--evaluations 400 --jobs 2`  \n`cosim bench exploit --cheats --suite reactive`  \n`cosim "
    "bench realism --place my-street --frames 20`  \n`cosim bench legs --robot dog --minutes 60`",
)
def bench(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="environment (one process, part by part), camera (all of them), "
            "crowd (behaviour of people and vehicles), people (the crowd compared with measured "
            "people), crossings (a policy, people and vehicles at signals), exploit (blind "
            "schedules that solve a suite), realism (what networks see in pictures) or legs (how a "
            "robot with legs walks).",
        ),
    ] = "environment",
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="For `environment` and `camera`: this measurement alone; for `exploit --cheats`: "
            "this cheat alone; repeatable.",
            rich_help_panel=_SEVERAL,
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="For `environment` and `camera`: another checkout, measured in turns, with "
            "ratios. For `realism`: realism.json of another run, shown next to this one.",
            rich_help_panel=_SEVERAL,
        ),
    ] = None,
    rounds: Annotated[
        int,
        typer.Option(
            min=1,
            help="Number of measurements of each figure; medians are shown.",
            rich_help_panel=_SPEED,
        ),
    ] = 3,
    cities: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of cities; default: 3 for `crowd`, 20 for `crossings`.",
            rich_help_panel=_SEVERAL,
        ),
    ] = None,
    minutes: Annotated[
        float,
        typer.Option(
            min=0.1,
            help="For `crowd`: simulated minutes in each; for `legs`: of random commands in all, "
            "a third on each of three grounds.",
            rich_help_panel=_SEVERAL,
        ),
    ] = 10.0,
    residents: Annotated[
        int, typer.Option(min=0, help="Number of residents.", rich_help_panel=_CROWD)
    ] = 0,
    crossings: Annotated[
        int, typer.Option(min=1, help="Number of crossings.", rich_help_panel=_CROSSINGS)
    ] = 200,
    policy: Annotated[str, typer.Option(help="Policy.", rich_help_panel=_CROSSINGS)] = "orca",
    jobs: Annotated[
        int,
        typer.Option(
            min=1,
            help="For `crossings`, `people` and `exploit`: processes.",
            rich_help_panel=_SEVERAL,
        ),
    ] = 1,
    groups: Annotated[float, typer.Option(help=help_of("groups"), rich_help_panel=_CROWD)] = 0.0,
    elderly: Annotated[float, typer.Option(help=help_of("elderly"), rich_help_panel=_CROWD)] = 0.0,
    children: Annotated[
        float, typer.Option(help=help_of("children"), rich_help_panel=_CROWD)
    ] = 0.0,
    suite: Annotated[
        str, typer.Option(help="Suite, or its .json.", rich_help_panel=_EXPLOIT)
    ] = "reactive",
    kinds: Annotated[
        str,
        typer.Option(
            metavar="KIND,...",
            help="Kinds of scenarios, `all` for a schedule for all of them; "
            "default: each, and `all`.",
            rich_help_panel=_EXPLOIT,
        ),
    ] = "",
    evaluations: Annotated[
        int,
        typer.Option(
            min=20,
            help="Episodes of the search for each kind.",
            rich_help_panel=_EXPLOIT,
        ),
    ] = 4000,
    objective: Annotated[
        str,
        typer.Option(
            metavar="sr,d",
            help="Maximize success, pairs of event and decoy, or each in turn.",
            rich_help_panel=_EXPLOIT,
        ),
    ] = "sr",
    seed: Annotated[
        int,
        typer.Option(min=0, help="Seed of the search.", rich_help_panel=_EXPLOIT),
    ] = 0,
    goal: Annotated[
        str,
        typer.Option(
            metavar="GOAL,...",
            help="Goal protocols; default: final_point, and for cheats their own.",
            rich_help_panel=_EXPLOIT,
        ),
    ] = "",
    folder: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FOLDER",
            help="For `exploit`: where evaluations are stored, and continued; default: "
            "runs/exploit-SUITE. For `realism`: where pictures with boxes are written.",
            rich_help_panel=_SEVERAL,
        ),
    ] = None,
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            help="Store the result next to the suite.",
            rich_help_panel=_EXPLOIT,
        ),
    ] = False,
    cheats: Annotated[
        bool,
        typer.Option(
            "--cheats",
            help="Drive the table of cheating schedules.",
            rich_help_panel=_EXPLOIT,
        ),
    ] = False,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Files of YOLOX-nano, FastestDet and ESPNetv2.",
            rich_help_panel=_REALISM,
        ),
    ] = None,
    places: Annotated[
        list[str] | None,
        typer.Option(
            "--place",
            metavar="NAME",
            help="Map; default: the cities of `long-horizon`; repeatable.",
            rich_help_panel=_REALISM,
        ),
    ] = None,
    split: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SPLIT",
            help="Routes of val, on which looks are tuned, or of test, which are "
            "held out; default: val; repeatable.",
            rich_help_panel=_REALISM,
        ),
    ] = None,
    weather: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Weather of the routes, one of those of `cosim list`; default: clear; repeatable.",
            rich_help_panel=_REALISM,
        ),
    ] = None,
    frames: Annotated[
        int,
        typer.Option(
            min=1,
            help="Frames of each place, split and weather.",
            rich_help_panel=_REALISM,
        ),
    ] = 80,
    appearance: Annotated[
        Appearance,
        typer.Option(metavar="APPEARANCE", help=help_of("appearance"), rich_help_panel=_REALISM),
    ] = "splats",
    robot: Annotated[str, typer.Option(help="Robot with legs.", rich_help_panel=_LEGS)] = "dog",
    gait: Annotated[
        str,
        typer.Option(
            metavar="onnx:FILE.onnx",
            help="Gait in place of the robot's own.",
            rich_help_panel=_LEGS,
        ),
    ] = "",
) -> None:
    """Measure the speed of an environment process or of cameras, behaviour in traffic, how far a
    suite can be solved blind, what networks see in pictures, or how a robot with legs walks."""
    choices = (
        "environment",
        "camera",
        "crowd",
        "people",
        "crossings",
        "exploit",
        "realism",
        "legs",
    )
    if what not in choices:
        raise unknown("bench", what, choices)
    if what == "crowd":
        bench_crowd(3 if cities is None else cities, minutes, residents, groups, elderly, children)
        return
    if what == "crossings":
        bench_crossings(crossings, min(20, crossings) if cities is None else cities, policy, jobs)
        return
    if what == "legs":
        bench_legs(robot, minutes, gait)
        return
    if what == "people":
        bench_people(jobs)
        return
    if what == "realism":
        skies, splits = weather or ("clear",), split or ("val",)
        bench_realism(places or (), splits, skies, frames, appearance, weights, folder, compare)
        return
    if what == "exploit":
        named, sought, goals = (
            [name for name in names.split(",") if name] for names in (kinds, objective, goal)
        )
        if cheats:
            bench_cheats(suite, named, jobs, folder, goals, only or ())
        else:
            bench_exploit(suite, named, evaluations, jobs, folder, sought, seed, goals, write)
        return
    only = only or []
    if compare is not None:
        _compare(compare, what, only, rounds)
    elif what == "camera" and not only:
        bench_cameras(rounds)
    else:
        print_figures(_figures_of(what, only, [None], rounds)[0])


def _figures_of(
    what: str, only: Sequence[str], checkouts: Sequence[Path | None], rounds: int
) -> list[dict[str, list[Figure]]]:
    """Return the figures of checkouts (None: this one), with a value per round."""
    from scenarios.tools.bench.figures import ROOT
    from scenarios.tools.bench.measurements import (
        CAMERA,
        ENVIRONMENT,
        ON_REQUEST,
        chosen,
        take_rounds,
    )

    environment = (*ENVIRONMENT, *ON_REQUEST) if only else ENVIRONMENT
    names = chosen(only, tuple(CAMERA) if what == "camera" else environment)
    with doing("measuring") as progress:
        return take_rounds(names, [one or ROOT for one in checkouts], rounds, progress)


def _compare(other: Path, what: str, only: Sequence[str], rounds: int) -> None:
    """Print medians and ratios of the figures that both checkouts have."""
    from scenarios.tools.bench.figures import measuring_module, spread

    measuring_module(other)
    here, there = _figures_of(what, only, [None, other.resolve()], rounds)
    rows = []
    for name in [name for name in here if name in there]:
        mine, theirs = ([one.value for one in found[name]] for found in (here, there))
        ratios = [a / b for a, b in zip(mine, theirs, strict=True)]
        rows.append((name, spread(mine)[0], spread(theirs)[0], *spread(ratios)))
    tables.show(
        out,
        [*tables.names("figure"), *tables.figures("here", "there", "here / there", "spread")],
        rows,
    )
    out.print(f"medians; a ratio a round, {rounds} in all, the checkouts in turns", highlight=False)


def print_figures(found: Mapping[str, Sequence[Figure]]) -> None:
    """Print a row per figure: median, spread, the engine's own time, ratio and target."""
    from scenarios.tools.bench.figures import spread

    rows = []
    limits: dict[str, None] = {}
    for name, rounds in found.items():
        first = rounds[0]
        ratios = [one.ratio for one in rounds if one.ratio is not None]
        limit = ratio = reach = mark = ""
        if ratios:
            limit, ratio = (
                spread(values)[0] for values in ([one.limit or 0.0 for one in rounds], ratios)
            )
            limits[first.limit_is] = None
            mark = f" [{list(limits).index(first.limit_is) + 1}]"
        if first.reach is not None:
            reach = (
                f"{'ratio' if first.reach_ratio else ''} {first.better} {first.reach:,.4g}".strip()
            )
        rows.append((name + mark, *spread([one.value for one in rounds]), limit, ratio, reach))
    tables.show(
        out,
        [*tables.names("figure"), *tables.figures("median", "spread", "limit", "ratio", "reach")],
        rows,
    )
    for i, words in enumerate(limits):
        out.print(f"limit [{i + 1}]: {words}", markup=False, highlight=False)


def bench_cameras(rounds: int) -> None:
    """Measure the cameras in one busy street, and print frames per second, targets and ratios."""
    from physics.cameras.choice import camera_of_choice, renderer_of
    from scenarios.tools.bench.cameras import FIGURES, PERSONS, RATIOS, SIZE, time_cameras
    from scenarios.tools.bench.figures import spread

    drawn_by = renderer_of(camera_of_choice("auto"))
    on_gpu = "llvmpipe" not in drawn_by and "bullet" not in drawn_by
    with doing("measuring") as progress:
        found = time_cameras(rounds, progress)
    head = f"busy street, {PERSONS} people in view, {SIZE[0]}x{SIZE[1]}"
    rows = []
    for figure in FIGURES:
        least = figure.least_fps[on_gpu]
        fps = found[figure.name].fps
        rows.append(
            (
                figure.name,
                *(spread(fps) if fps else NO_FIGURE),
                "" if least is None else f">= {least:,.4g}",
            )
        )
    tables.show(out, [*tables.names(head), *tables.figures("frames/s", "spread", "target")], rows)
    ratios = []
    for name, above, below, target in RATIOS:
        values = [a / b for a, b in zip(found[above].fps, found[below].fps, strict=False)]
        ratios.append((name, *(spread(values) if values else NO_FIGURE), target))
    tables.show(
        out, [*tables.names("ratio"), *tables.figures("median", "spread", "target")], ratios
    )
    out.print(
        f"{drawn_by}; {rounds} {'round' if rounds == 1 else 'rounds'}, medians", highlight=False
    )
    wrong: dict[str, list[str]] = {}
    for name, one in found.items():
        if one.why:
            wrong.setdefault(one.why, []).append(name)
    for why, names in wrong.items():
        say(f"{'; '.join(names)} cannot be drawn here: {why}")
    if wrong:
        out.print("What the machine lacks, and how to get it: `cosim doctor`.", highlight=False)
