"""The command line of measurements: `cosim bench`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from cosim.cli.consoles import out
from cosim.cli.crowd import CHILDREN_HELP, ELDERLY_HELP, GROUPS_HELP, bench_crossings, bench_crowd
from cosim.cli.progress import doing
from cosim.core.errors import unknown

NONE = ("none: see below", "")


def bench(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="environment (one process, part by part), camera (all of them side by side), crowd (how people and "
            "vehicles behave) or crossings (how a policy, they and the lights get on).",
        ),
    ] = "environment",
    rounds: Annotated[int, typer.Option(min=1, help="How often each figure is taken; medians are shown.")] = 3,
    cities: Annotated[
        int | None, typer.Option(min=1, help="How many cities: 3 for `crowd`, 20 for `crossings` unless you say.")
    ] = None,
    minutes: Annotated[float, typer.Option(min=0.1, help="For `crowd`: simulated minutes in each.")] = 10.0,
    residents: Annotated[int, typer.Option(min=0, help="For `crowd`: residents beside the crowd.")] = 0,
    crossings: Annotated[int, typer.Option(min=1, help="For `crossings`: how many in all.")] = 200,
    policy: Annotated[str, typer.Option(help="For `crossings`: who drives over them.")] = "orca",
    jobs: Annotated[int, typer.Option(min=1, help="For `crossings`: environment processes.")] = 1,
    groups: Annotated[float, typer.Option(help=f"For `crowd`: {GROUPS_HELP}")] = 0.0,
    elderly: Annotated[float, typer.Option(help=f"For `crowd`: {ELDERLY_HELP}")] = 0.0,
    children: Annotated[float, typer.Option(help=f"For `crowd`: {CHILDREN_HELP}")] = 0.0,
) -> None:
    """Measure one environment process, part by part, the cameras, or what robot, people and vehicles do in traffic."""
    choices = ("environment", "camera", "crowd", "crossings")
    if what not in choices:
        raise unknown("bench", what, choices)
    if what == "crowd":
        bench_crowd(3 if cities is None else cities, minutes, residents, groups, elderly, children)
        return
    if what == "crossings":
        bench_crossings(crossings, min(20, crossings) if cities is None else cities, policy, jobs)
        return
    if what == "camera":
        bench_cameras(rounds)
        return
    from scenarios.bench import street as bench_street
    from scenarios.bench.speed import TIMED_PARTS, spread, time_episodes

    with doing("measuring") as tell:
        report = time_episodes(rounds, lambda words: tell(f"measuring: {words}"))
        streets = bench_street.time_street(rounds, lambda words: tell(f"measuring: {words}"))
    table = Table("2 km city, 50 persons, 20 vehicles, 96x96 camera at 4 Hz", "median", "spread", "target")
    rows: list[tuple[str, list[float], str]] = [
        ("simulated seconds per second", [d.factor for d in report.big], ">= 8"),
        ("first frame of the cached city, s", report.first_frame_s, "<= 5"),
        ("resident memory, MiB", [d.memory_mib for d in report.big], "<= 1024"),
        ("cost of a step: 2 km / 0.5 km", report.growth(), "about 1"),
        ("director's round trip, ms", [d.round_trip_ms for d in report.big], "<= 0.4"),
        ("persons shown", [float(d.people) for d in report.big], ""),
    ]
    for name, values, target in rows:
        table.add_row(name, *spread(values), target)
    out.print(table)
    parts = Table("part", "ms per simulated second", "spread", "share inside the engine")
    for part in TIMED_PARTS:
        inside = [d.engine_ms[part] / d.ms[part] for d in report.big if part in d.engine_ms]
        parts.add_row(part, *spread([d.ms[part] for d in report.big]), spread(inside)[0] if inside else "")
    out.print(parts)
    around = f"{bench_street.VEHICLES} vehicles, robot, {bench_street.CAST} event pedestrians"
    street = Table(f"step of the street: {around}", "median", "spread", "target")
    for (persons, taken), target in zip(streets.items(), ("<= 1.0", "<= 2.0"), strict=True):
        street.add_row(f"{persons} persons within 80 m, ms", *spread([one.ms for one in taken]), target)
        street.add_row("  of it inside SUMO's step, ms", *spread([one.engine_ms for one in taken]), "")
        street.add_row("  people shown", *spread([one.shown for one in taken]), "")
    out.print(street)
    places = Table("2 km city", "median", "spread", "target")
    places.add_row("seed to street map, s", *spread([p.made_s for p in report.places]), "<= 4")
    places.add_row("cache to street map, s", *spread([p.read_s for p in report.places]), "<= 0.5")
    places.add_row("point in walkable area, us", *spread([p.contains_us for p in report.places]), "<= 5")
    places.add_row("distance to its edge, us", *spread([p.distance_us for p in report.places]), "<= 20")
    places.add_row("shortest walk, ms", *spread([p.walk_ms for p in report.places]), "<= 2")
    out.print(places)


def bench_cameras(rounds: int) -> None:
    """Measure the cameras in one busy street and print frames a second, targets and ratios."""
    from physics.cameras.choice import camera_of_choice, renderer_of
    from scenarios.bench.cameras import FIGURES, PERSONS, RATIOS, SIZE, time_cameras
    from scenarios.bench.speed import spread

    drawn_by = renderer_of(camera_of_choice("auto"))
    on_gpu = "llvmpipe" not in drawn_by and "bullet" not in drawn_by
    with doing("measuring") as tell:
        found = time_cameras(rounds, lambda words: tell(f"measuring: {words}"))
    head = f"busy street, {PERSONS} people in view, {SIZE[0]}x{SIZE[1]}"
    table = Table(head, "frames/s", "spread", "target")
    for figure in FIGURES:
        least, fps = figure.least_fps[on_gpu], found[figure.name].fps
        table.add_row(figure.name, *(spread(fps) if fps else NONE), "" if least is None else f">= {least:,.4g}")
    out.print(table)
    ratios = Table("ratio", "median", "spread", "target")
    for name, above, below, target in RATIOS:
        values = [a / b for a, b in zip(found[above].fps, found[below].fps, strict=False)]
        ratios.add_row(name, *(spread(values) if values else NONE), target)
    out.print(ratios)
    out.print(f"{drawn_by}; {rounds} {'round' if rounds == 1 else 'rounds'}, medians", highlight=False)
    wrong: dict[str, list[str]] = {}
    for name, one in found.items():
        if one.why:
            wrong.setdefault(one.why, []).append(name)
    for why, names in wrong.items():
        out.print(f"{'; '.join(names)} cannot be drawn here: {why}", soft_wrap=True, markup=False, highlight=False)
    if wrong:
        out.print("What the machine lacks, and how to get it: `cosim doctor`.", highlight=False)
