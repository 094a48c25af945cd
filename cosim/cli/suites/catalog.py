"""`cosim list`: what there is to run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted

if TYPE_CHECKING:
    from cosim.spec.scenario import Suite

list_app = typer.Typer()


@list_app.command("list", epilog="Examples:  \n`cosim list`  \n`cosim list reactive`")
def list_all(
    suite: Annotated[str | None, typer.Argument(help="Show the scenarios of this suite.")] = None,
) -> None:
    """List the suites, robots, policies and goals, or the scenarios of a suite."""
    from scenarios.catalog import load_suite

    if suite is None:
        print_names(out)
        return
    print_scenarios(out, load_suite(suite))


def print_names(out: Console) -> None:
    """Suites, robots and their cameras, policies, goals: a line for each."""
    from cosim.policies import POLICIES
    from cosim.policies.follow.networks import weights_in_words
    from cosim.policies.follow.policy import Follow
    from cosim.policies.shipped import bundle_in_words, shipped_bundles
    from cosim.records.results import policy_in_words
    from cosim.spec.goal import GOALS
    from cosim.spec.robot import ROBOTS
    from scenarios.catalog import SUITES, load_suite

    for name in SUITES:
        whole = load_suite(name)
        out.print(f"suite   {name}  {len(whole.scenarios)} scenarios, version {whole.version}, {whole.content_hash}")
    for one in ROBOTS.values():
        size = f"{one.length_m:.2f} x {one.width_m:.2f} m"
        out.print(f"robot   {one.name}  {size}, travels at {one.cruise_mps:g} m/s, turns at {one.w_max_radps:g} rad/s")
        for name, mount in one.mounts.items():
            out.print(f"camera  {one.name} {name}  {mount.in_words}", soft_wrap=True)
    for name, make in POLICIES.items():
        called = policy_in_words(name, make().manifest.privileged)
        out.print(f"policy  {called}  {(make.__doc__ or '').splitlines()[0]}", soft_wrap=True)
    for name, folder in shipped_bundles().items():
        out.print(f"policy  {name}  {bundle_in_words(folder)}", soft_wrap=True)
    about = (Follow.__doc__ or "").splitlines()[0]
    out.print(f"policy  {Follow.manifest.name}  {about} {weights_in_words()}", soft_wrap=True)
    for name, words in GOALS.items():
        out.print(f"goal    {name}  {words}", soft_wrap=True)


def print_scenarios(out: Console, suite: Suite) -> None:
    """A row per scenario of a suite: made for 80 columns."""
    heads = ("scenario", "place", "route\nm", "cross-\nings", "events", "bar-\nriers", "limit\ns")
    shown = Table(*(Column(head, no_wrap=True) for head in heads), box=box.SIMPLE_HEAD, padding=0)
    for s in suite.scenarios:
        events = s.events[0].kind if len(s.events) == 1 else str(len(s.events))
        numbers = (f"{s.route_line.length_m:.0f}", str(len(s.crossings)), events, str(len(s.barriers)))
        shown.add_row(s.id, escape(s.place.name), *numbers, f"{s.time_limit_s:.0f}")
    print_fitted(out, shown)
