"""The command line of street life: `cosim bench crowd`, `cosim counterfactual`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

out = Console()
err = Console(stderr=True)

SHARES = (
    ("overlaps", "pairs in contact range", "< 0.1 %"),
    ("pairs nearer than 0.45 m", "pairs in contact range", ""),
    ("pairs nearer than 0.6 m", "pairs in contact range", ""),
    ("within 0.15 m of a thing", "persons", ""),
    ("in a building", "persons", "0"),
    ("in a thing in the clear band", "persons", "0"),
    ("in a vehicle", "persons", "0"),
    ("off the walkable area", "persons", ""),
    ("persons entered at red", "persons entered signalised crossings", "0"),
    ("persons entered within a second of red", "persons entered signalised crossings", ""),
    ("vehicles passed at red", "vehicles passed stop lines", "0"),
    ("vehicles passed within a second of red", "vehicles passed stop lines", ""),
    ("vehicles passed at yellow", "vehicles passed stop lines", ""),
)
"""What is counted, of what, and the target."""


def bench_crowd(cities: int, minutes: float) -> None:
    """Watch the crowd of several cities and print how people keep apart, out of things and to the lights."""
    from cosim.scenario import CrowdSpec
    from scenarios.bench_crowd import summed, watch_all

    with err.status("watching ...") as status:
        found = watch_all(cities, minutes, CrowdSpec(), lambda words: status.update(f"watching: {words}"))
    counts = summed(one.counts for one in found)
    total_min = sum(one.minutes for one in found)
    places = f"{len(found)} cities, {total_min:.0f} min, {sum(f.crossings for f in found)} signalised crossings entered"
    table = Table(places, "count", "of", "share", "target")
    told = set()
    for name, whole, target in SHARES:
        told |= {name, whole}
        count, of = counts.get(name, 0.0), counts.get(whole, 0.0)
        share = f"{100.0 * count / of:.4f} %" if of else ""
        table.add_row(name, f"{count:.2f}", f"{of:.0f} {whole}", share, target)
    for name in sorted(counts.keys() - told):
        table.add_row(name, f"{counts[name]:.2f}", "", "", "")
    out.print(table)
    out.print("People and pairs are counted in seconds, entries and vehicles one by one.")
    each = Table("city", "min", "persons", "overlaps, share of pair-seconds", "crowd's step, ms")
    for one in found:
        overlaps = one.counts.get("overlaps", 0.0) / max(one.counts.get("pairs in contact range", 0.0), 1e-9)
        each.add_row(
            one.place, f"{one.minutes:.0f}", f"{one.persons:.0f}", f"{100 * overlaps:.4f} %", f"{one.crowd_ms:.2f}"
        )
    out.print(each)


def counterfactual(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    episode: Annotated[str, typer.Argument(help="One of its episodes.")],
) -> None:
    """Replay an episode, simulate its street again without the robot, and print whom the robot delayed by how much."""
    from cosim.delay import NEAR_M
    from scenarios.counterfactual import counterfactual as compare
    from scenarios.replay import check, recorded

    with err.status(f"{episode}, with and without its robot ..."):
        told = recorded(folder, episode)
        found = compare(told)
    check(folder, told, found.state_hash)
    table = Table(episode, f"delay, s: within {NEAR_M:g} m", "of", "delay, s: all", "of", "not comparable")
    for name, delay in (("people", found.people), ("vehicles", found.vehicles)):
        near, everybody = (f"{delay.near_s:+.1f}", str(delay.near)), (f"{delay.delay_s:+.1f}", str(delay.compared))
        table.add_row(name, *near, *everybody, str(delay.unmatched))
    out.print(table)
