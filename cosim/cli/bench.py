"""The command `cosim bench`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.markup import escape
from rich.table import Column, Table

from cosim.cli.console import out
from cosim.cli.options import MEASURE
from cosim.cli.progress import doing
from cosim.cli.tables import print_fitted
from cosim.core.errors import UsageError, unknown
from cosim.spec.run_config import help_of

if TYPE_CHECKING:
    from cosim.core.geometry import Floats
    from scenarios.tools.bench.figures import Figure
    from scenarios.tools.bench.people.comparison import Comparison
    from scenarios.tools.bench.people.observed import MeanSd


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
"""What is counted, of what, and the target."""


def bench_crowd(
    cities: int, minutes: float, residents: int, groups: float, elderly: float, children: float
) -> None:
    """Watch the crowd of several cities and print how people keep apart, out of things and to the
    lights."""
    from cosim.spec.scenario import CrowdSpec
    from scenarios.tools.bench.crowd import summed, watch_all
    from scenarios.tools.bench.group_tally import APART_M

    spec = CrowdSpec(residents=residents, groups=groups, elderly=elderly, children=children)
    with doing("watching the crowd") as tell:
        found = watch_all(cities, minutes, spec, lambda words: tell(f"watching the crowd: {words}"))
    counts = summed(one.counts for one in found)
    total_min = sum(one.minutes for one in found)
    places = (
        f"{len(found)} cities, {total_min:.0f} min, {sum(f.crossings for f in found)} signalised "
        f"crossings entered"
    )
    table = Table(places, "count", "of", "share", "target")
    _add_shares(table, SHARES, counts)
    told = {name for name, whole, _ in SHARES for name in (name, whole)}
    for name in sorted(counts.keys() - told):
        table.add_row(name, f"{counts[name]:.2f}", "", "", "")
    print_fitted(out, table)
    out.print("People and pairs are counted in seconds, entries and vehicles one by one.")
    each = Table(
        "city", "min", "persons", "overlaps, share of pair-seconds", "crowd's step, CPU ms"
    )
    for one in found:
        overlaps = one.counts.get("overlaps", 0.0) / max(
            one.counts.get("pairs in contact range", 0.0), 1e-9
        )
        each.add_row(
            one.place,
            f"{one.minutes:.0f}",
            f"{one.persons:.0f}",
            f"{100 * overlaps:.4f} %",
            f"{one.crowd_ms:.2f}",
        )
    print_fitted(out, each)
    if gaps_m := sorted(gap for one in found for gap in one.group_gaps_m):
        middle, most = (gaps_m[int(share * len(gaps_m))] for share in (0.5, 0.95))
        apart = sum(gap > APART_M for gap in gaps_m) / len(gaps_m)
        out.print(
            f"Groups, the loneliest member's distance to its nearest fellow: median {middle:.2f} "
            f"m, 95 % within {most:.2f} m, beyond {APART_M:g} m {100 * apart:.2f} % of the time."
        )


def bench_crossings(crossings: int, cities: int, policy: str, jobs: int) -> None:
    """Drive a policy over signalised crossings and print how it, the crowd and the vehicles keep to
    the lights."""
    from scenarios.tools.bench.crossings import cross_all, crossings_entered
    from scenarios.tools.bench.crowd import summed

    with doing("drawing crossings") as tell:
        rows = cross_all(crossings, cities, policy, jobs, lambda words: tell(f"driving: {words}"))
    places = (
        f"cities: {len({row.city for row in rows})}, minutes: "
        f"{sum(row.minutes for row in rows):.0f}"
    )
    robot = Table(policy, "", f"signalised crossings: {len(rows)}, {places}")
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
        robot.add_row(name, str(len(rows_with)), "" if name == "reached the goal" else named)
    mean = f"{sum(waited) / len(waited):.1f} s each on the mean" if waited else ""
    robot.add_row("waited at red", str(len(waited)), mean)
    robot.add_row(
        "on the carriageway, or on a crossing at red",
        f"{sum(r.carriageway_s for r in rows):.1f} s",
        "",
    )
    print_fitted(out, robot, words=[2])
    counts = summed(row.counts for row in rows)
    lights = Table(
        f"crowd and vehicles, {crossings_entered(rows)} crossings entered",
        "count",
        "of",
        "share",
        "target",
    )
    _add_shares(lights, LIGHTS, counts)
    for name in ("vehicles drove over a crossing at walk", "vehicles within 1 m of a walker on it"):
        lights.add_row(name, f"{counts.get(name, 0.0):.2f}", "", "", "")
    print_fitted(out, lights)
    for row in rows:
        for who in row.at_red:
            out.print(f"{row.scenario}: {who}", soft_wrap=True, markup=False, highlight=False)


def _add_shares(
    table: Table, shares: tuple[tuple[str, str, str], ...], counts: Mapping[str, float]
) -> None:
    for name, whole, target in shares:
        count, of = counts.get(name, 0.0), counts.get(whole, 0.0)
        share = f"{100.0 * count / of:.4f} %" if of else ""
        table.add_row(name, f"{count:.2f}", f"{of:.0f} {whole}", share, target)


_NOTES = (
    "Density and speed by pedpy. Speed by density: everybody in a window of 2 x 3.2 m in the "
    "middle of a straight sidewalk that leads round a block, frame by frame; off: how many of the "
    "data's standard deviations ours lies beside its mean. Free speed: of each person while "
    "nobody is within 3 m, of those who walk so for 3 s. Nearest: that of our streets whose "
    "median is nearest, for how dense the films were is not known. Gaps: a marked crossing "
    "without signals, where vehicles yield; people and vehicles of each direction come every 10 s "
    "on the mean. How often they came in DUT, where nothing is marked, is not known: the low "
    "percentiles say most.",
    "Distances: of means and deviations the 2-Wasserstein distance between normal "
    "distributions that have them, "
    "of percentiles the 1-Wasserstein distance over those given, their mean difference.",
)


def bench_people(jobs: int) -> None:
    """Let the crowd walk on sidewalks and over a crossing and print it beside what was measured of
    people."""
    from scenarios.tools.bench.people.comparison import watch_people

    with doing("watching people") as tell:
        found = watch_people(jobs, lambda words: tell(f"watching people: {words}"))
    for table in (_by_density(found), _free(found), _nearest(found), _gaps(found)):
        print_fitted(out, table)
    for note in _NOTES:
        out.print(note, highlight=False)


def _by_density(found: Comparison) -> Table:
    from scenarios.tools.bench.people.measures import normal_distance
    from scenarios.tools.bench.people.observed import DENSITY_EDGES, SPEED_BY_DENSITY_MPS

    table = _table(
        "persons/m2", "HERMES", "one way", "dist.", "off, sd", "both ways", "dist.", "off, sd"
    )
    table.title = "Speed by density, m/s"
    for k, data in enumerate(SPEED_BY_DENSITY_MPS):
        cells = []
        for ours, _ in (way[k] for way in found.by_density):
            off = (ours.mean - data.mean) / data.sd
            cells += [_spread(ours), f"{normal_distance(ours, data):.2f}", f"{off:+.1f}"]
        table.add_row(f"{DENSITY_EDGES[k]:g} to {DENSITY_EDGES[k + 1]:g}", _spread(data), *cells)
    person_s = [" ".join(f"{seconds:.0f}" for _, seconds in way) for way in found.by_density]
    table.caption = f"person-seconds: one way {person_s[0]}; both ways {person_s[1]}"
    return table


def _free(found: Comparison) -> Table:
    from scenarios.tools.bench.people.measures import mean_sd, normal_distance
    from scenarios.tools.bench.people.observed import FREE_SPEED_MPS

    ours = mean_sd(found.free_mps)
    table = _table("", "data", "ours", "dist.")
    table.title = "Free speed, m/s"
    for name, data in FREE_SPEED_MPS.items():
        table.add_row(name, _spread(data), _spread(ours), f"{normal_distance(ours, data):.2f}")
    return table


def _nearest(found: Comparison) -> Table:
    from scenarios.tools.bench.people.comparison import GROUPS, alike
    from scenarios.tools.bench.people.measures import percentile_distance
    from scenarios.tools.bench.people.observed import NEAREST_M, NEAREST_PERCENT

    table = _table("", _percent(NEAREST_PERCENT), "ours", "dist.", "in groups", "persons/m2")
    table.title = "Nearest neighbour, m"
    for share in GROUPS:
        for name, data in NEAREST_M.items():
            flow, apart_m = alike(
                [one for one in found.nearest if one.flow.groups == share], data[-1]
            )
            far_m = percentile_distance(apart_m, NEAREST_PERCENT, data)
            ours = _percentiles(apart_m, NEAREST_PERCENT)
            table.add_row(
                name, _list(data), ours, f"{far_m:.2f}", f"{100 * share:.0f} %", f"{flow.density:g}"
            )
    return table


def _gaps(found: Comparison) -> Table:
    from scenarios.tools.bench.people.measures import percentile_distance
    from scenarios.tools.bench.people.observed import (
        PERSON_FIRST_PERCENT,
        PERSON_FIRST_S,
        VEHICLE_FIRST_PERCENT,
        VEHICLE_FIRST_S,
    )

    table = _table("", "DUT", "ours", "dist.", "gaps")
    table.title = "Gaps at a crossing without signals (post-encroachment times), s"
    for name, percent, data, ours in (
        ("person first", PERSON_FIRST_PERCENT, PERSON_FIRST_S, found.person_first_s),
        ("vehicle first", VEHICLE_FIRST_PERCENT, VEHICLE_FIRST_S, found.vehicle_first_s),
    ):
        far_s = percentile_distance(ours, percent, data)
        cells = (_list(data), _percentiles(ours, percent), f"{far_s:.2f}", str(len(ours)))
        table.add_row(f"{name}: {_percent(percent)}", *cells)
    return table


def _table(first: str, *others: str) -> Table:
    heads = [Column(head, no_wrap=True, justify="right") for head in others]
    return Table(
        Column(first, no_wrap=True),
        *heads,
        box=box.SIMPLE_HEAD,
        padding=0,
        title_justify="left",
        caption_justify="left",
    )


def _spread(one: MeanSd) -> str:
    return f"{one.mean:.2f} ± {one.sd:.2f}"


def _percent(percent: Sequence[float]) -> str:
    return "/".join(f"{one:g}" for one in percent) + " %"


def _list(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def _percentiles(values: Floats, percent: Sequence[float]) -> str:
    import numpy as np

    return _list(np.percentile(values, percent).tolist())


bench_app = typer.Typer()
NONE = ("none: see below", "")


@bench_app.command(
    rich_help_panel=MEASURE,
    epilog="Examples:  \n`cosim bench --rounds 5`  \n`cosim bench --only driving --compare "
    "../cosim-before`  \n`cosim bench camera`  \n`cosim bench crowd --cities 10`  \n`cosim bench "
    "crossings --crossings 40 --jobs 2 --policy orca`",
)
def bench(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="environment (one process, part by part), camera (all of them side by side), "
            "crowd (how people and vehicles behave), people (how the crowd walks, beside what was "
            "measured of people) or crossings (how a policy, they and the lights get on).",
        ),
    ] = "environment",
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="For `environment` and `camera`: this measurement alone; repeatable.",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="CHECKOUT",
            help="For `environment` and `camera`: take each figure there too, in turns, and show "
            "the ratios.",
        ),
    ] = None,
    rounds: Annotated[
        int, typer.Option(min=1, help="How often each figure is taken; medians are shown.")
    ] = 3,
    cities: Annotated[
        int | None,
        typer.Option(
            min=1, help="How many cities: 3 for `crowd`, 20 for `crossings` unless you say."
        ),
    ] = None,
    minutes: Annotated[
        float, typer.Option(min=0.1, help="For `crowd`: simulated minutes in each.")
    ] = 10.0,
    residents: Annotated[
        int, typer.Option(min=0, help="For `crowd`: residents beside the crowd.")
    ] = 0,
    crossings: Annotated[int, typer.Option(min=1, help="For `crossings`: how many in all.")] = 200,
    policy: Annotated[str, typer.Option(help="For `crossings`: who drives over them.")] = "orca",
    jobs: Annotated[int, typer.Option(min=1, help="For `crossings` and `people`: processes.")] = 1,
    groups: Annotated[float, typer.Option(help=f"For `crowd`: {help_of('groups')}")] = 0.0,
    elderly: Annotated[float, typer.Option(help=f"For `crowd`: {help_of('elderly')}")] = 0.0,
    children: Annotated[float, typer.Option(help=f"For `crowd`: {help_of('children')}")] = 0.0,
) -> None:
    """Measure one environment process, part by part, the cameras, or what robot, people and
    vehicles do in traffic."""
    choices = ("environment", "camera", "crowd", "people", "crossings")
    if what not in choices:
        raise unknown("bench", what, choices)
    if what == "crowd":
        bench_crowd(3 if cities is None else cities, minutes, residents, groups, elderly, children)
        return
    if what == "crossings":
        bench_crossings(crossings, min(20, crossings) if cities is None else cities, policy, jobs)
        return
    if what == "people":
        bench_people(jobs)
        return
    only = only or []
    if compare is not None:
        _compare(compare, what, only, rounds)
    elif what == "camera" and not only:
        bench_cameras(rounds)
    else:
        print_figures(_taken(what, only, [None], rounds)[0])


def _taken(
    what: str, only: Sequence[str], checkouts: Sequence[Path | None], rounds: int
) -> list[dict[str, list[Figure]]]:
    """The figures of checkouts, None for this one, each value of each round."""
    from scenarios.tools.bench.measurements import (
        CAMERA,
        ENVIRONMENT,
        ON_REQUEST,
        ROOT,
        chosen,
        take_rounds,
    )

    environment = (*ENVIRONMENT, *ON_REQUEST) if only else ENVIRONMENT
    names = chosen(only, tuple(CAMERA) if what == "camera" else environment)
    with doing("measuring") as tell:
        return take_rounds(
            names,
            [one or ROOT for one in checkouts],
            rounds,
            lambda words: tell(f"measuring: {words}"),
        )


def _compare(other: Path, what: str, only: Sequence[str], rounds: int) -> None:
    """A row per figure that both checkouts take: medians here and there, and the ratio round by
    round."""
    from scenarios.tools.bench.figures import spread

    if not (other / "scenarios" / "bench" / "take.py").is_file():
        raise UsageError(
            f"--compare {other}: no checkout of cosim that can be measured "
            f"(scenarios/tools/bench/take.py)"
        )
    here, there = _taken(what, only, [None, other.resolve()], rounds)
    table = Table(
        *_columns("figure", "here", "there", "here / there", "spread"),
        box=box.SIMPLE_HEAD,
        padding=0,
    )
    for name in [name for name in here if name in there]:
        mine, theirs = ([one.value for one in found[name]] for found in (here, there))
        ratios = [a / b for a, b in zip(mine, theirs, strict=True)]
        table.add_row(name, spread(mine)[0], spread(theirs)[0], *spread(ratios))
    print_fitted(out, table)
    out.print(f"medians; a ratio a round, {rounds} in all, the checkouts in turns", highlight=False)


def print_figures(found: Mapping[str, Sequence[Figure]]) -> None:
    """A row per figure: the median of its rounds, the engine's own time, their ratio, and what
    should be reached."""
    from scenarios.tools.bench.figures import spread

    heads = ("figure", "median", "spread", "limit", "ratio", "reach")
    table = Table(*_columns(*heads), box=box.SIMPLE_HEAD, padding=0)
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
        table.add_row(
            escape(name + mark), *spread([one.value for one in rounds]), limit, ratio, reach
        )
    print_fitted(out, table)
    for i, words in enumerate(limits):
        out.print(f"limit [{i + 1}]: {words}", markup=False, highlight=False)


def _columns(first: str, *others: str) -> list[Column]:
    return [
        Column(first, overflow="fold"),
        *(Column(head, no_wrap=True, justify="right") for head in others),
    ]


def bench_cameras(rounds: int) -> None:
    """Measure the cameras in one busy street and print frames a second, targets and ratios."""
    from physics.cameras.choice import camera_of_choice, renderer_of
    from scenarios.tools.bench.cameras import FIGURES, PERSONS, RATIOS, SIZE, time_cameras
    from scenarios.tools.bench.figures import spread

    drawn_by = renderer_of(camera_of_choice("auto"))
    on_gpu = "llvmpipe" not in drawn_by and "bullet" not in drawn_by
    with doing("measuring") as tell:
        found = time_cameras(rounds, lambda words: tell(f"measuring: {words}"))
    head = f"busy street, {PERSONS} people in view, {SIZE[0]}x{SIZE[1]}"
    table = Table(head, "frames/s", "spread", "target")
    for figure in FIGURES:
        least = figure.least_fps[on_gpu]
        fps = found[figure.name].fps
        table.add_row(
            figure.name,
            *(spread(fps) if fps else NONE),
            "" if least is None else f">= {least:,.4g}",
        )
    print_fitted(out, table)
    ratios = Table("ratio", "median", "spread", "target")
    for name, above, below, target in RATIOS:
        values = [a / b for a, b in zip(found[above].fps, found[below].fps, strict=False)]
        ratios.add_row(name, *(spread(values) if values else NONE), target)
    print_fitted(out, ratios)
    out.print(
        f"{drawn_by}; {rounds} {'round' if rounds == 1 else 'rounds'}, medians", highlight=False
    )
    wrong: dict[str, list[str]] = {}
    for name, one in found.items():
        if one.why:
            wrong.setdefault(one.why, []).append(name)
    for why, names in wrong.items():
        out.print(
            f"{'; '.join(names)} cannot be drawn here: {why}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    if wrong:
        out.print("What the machine lacks, and how to get it: `cosim doctor`.", highlight=False)
