"""The command line of street life: `cosim bench crowd`, `cosim bench crossings`."""

from __future__ import annotations

from collections.abc import Mapping

from rich.table import Table

from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing

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


def bench_crowd(cities: int, minutes: float, residents: int, groups: float, elderly: float, children: float) -> None:
    """Watch the crowd of several cities and print how people keep apart, out of things and to the lights."""
    from cosim.spec.scenario import CrowdSpec
    from scenarios.bench.crowd import summed, watch_all
    from scenarios.bench.group_tally import APART_M

    spec = CrowdSpec(residents=residents, groups=groups, elderly=elderly, children=children)
    with doing("watching the crowd") as tell:
        found = watch_all(cities, minutes, spec, lambda words: tell(f"watching the crowd: {words}"))
    counts = summed(one.counts for one in found)
    total_min = sum(one.minutes for one in found)
    places = f"{len(found)} cities, {total_min:.0f} min, {sum(f.crossings for f in found)} signalised crossings entered"
    table = Table(places, "count", "of", "share", "target")
    _add_shares(table, SHARES, counts)
    told = {name for name, whole, _ in SHARES for name in (name, whole)}
    for name in sorted(counts.keys() - told):
        table.add_row(name, f"{counts[name]:.2f}", "", "", "")
    print_fitted(out, table)
    out.print("People and pairs are counted in seconds, entries and vehicles one by one.")
    each = Table("city", "min", "persons", "overlaps, share of pair-seconds", "crowd's step, CPU ms")
    for one in found:
        overlaps = one.counts.get("overlaps", 0.0) / max(one.counts.get("pairs in contact range", 0.0), 1e-9)
        each.add_row(
            one.place, f"{one.minutes:.0f}", f"{one.persons:.0f}", f"{100 * overlaps:.4f} %", f"{one.crowd_ms:.2f}"
        )
    print_fitted(out, each)
    if gaps_m := sorted(gap for one in found for gap in one.group_gaps_m):
        middle, most = (gaps_m[int(share * len(gaps_m))] for share in (0.5, 0.95))
        apart = sum(gap > APART_M for gap in gaps_m) / len(gaps_m)
        out.print(
            f"Groups, the loneliest member's distance to its nearest fellow: median {middle:.2f} m, 95 % within "
            f"{most:.2f} m, beyond {APART_M:g} m {100 * apart:.2f} % of the time."
        )


def bench_crossings(crossings: int, cities: int, policy: str, jobs: int) -> None:
    """Drive a policy over signalised crossings and print how it, the crowd and the vehicles keep to the lights."""
    from scenarios.bench.crossings import cross_all, crossings_entered
    from scenarios.bench.crowd import summed

    with doing("drawing crossings") as tell:
        rows = cross_all(crossings, cities, policy, jobs, lambda words: tell(f"driving: {words}"))
    places = f"cities: {len({row.city for row in rows})}, minutes: {sum(row.minutes for row in rows):.0f}"
    robot = Table(policy, "", f"signalised crossings: {len(rows)}, {places}")
    waited = [row.waited_s for row in rows if row.waited_s > 0.0]
    for name, rows_with in (
        ("reached the goal", [row for row in rows if row.ended == "goal"]),
        ("entered at red", [row for row in rows if row.red_entries]),
        ("failed", [row for row in rows if row.failures]),
        ("made vehicles brake", [row for row in rows if row.vehicles_braked]),
        ("crashed", [row for row in rows if row.ended == "crashed"]),
    ):
        named = ", ".join(f"{row.scenario or row.city} {row.reason}{', '.join(row.failures)}" for row in rows_with)
        robot.add_row(name, str(len(rows_with)), "" if name == "reached the goal" else named)
    mean = f"{sum(waited) / len(waited):.1f} s each on the mean" if waited else ""
    robot.add_row("waited at red", str(len(waited)), mean)
    robot.add_row("on the carriageway, or on a crossing at red", f"{sum(r.carriageway_s for r in rows):.1f} s", "")
    print_fitted(out, robot, words=[2])
    counts = summed(row.counts for row in rows)
    lights = Table(f"crowd and vehicles, {crossings_entered(rows)} crossings entered", "count", "of", "share", "target")
    _add_shares(lights, LIGHTS, counts)
    for name in ("vehicles drove over a crossing at walk", "vehicles within 1 m of a walker on it"):
        lights.add_row(name, f"{counts.get(name, 0.0):.2f}", "", "", "")
    print_fitted(out, lights)
    for row in rows:
        for who in row.at_red:
            out.print(f"{row.scenario}: {who}", soft_wrap=True, markup=False, highlight=False)


def _add_shares(table: Table, shares: tuple[tuple[str, str, str], ...], counts: Mapping[str, float]) -> None:
    for name, whole, target in shares:
        count, of = counts.get(name, 0.0), counts.get(whole, 0.0)
        share = f"{100.0 * count / of:.4f} %" if of else ""
        table.add_row(name, f"{count:.2f}", f"{of:.0f} {whole}", share, target)
