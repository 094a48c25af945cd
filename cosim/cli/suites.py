"""The commands `cosim list` and `cosim suite`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.console import Console

from cosim.cli import tables
from cosim.cli.console import notice, out, say
from cosim.cli.progress import doing
from cosim.core.errors import SOME_CRASHED, SpecError, unknown

if TYPE_CHECKING:
    from cosim.spec.scenario import Suite


list_app = typer.Typer()


@list_app.command("list", epilog="Examples:  \n`cosim list`  \n`cosim list reactive`")
def list_all(
    suite: Annotated[str | None, typer.Argument(help="Show the scenarios of this suite.")] = None,
) -> None:
    """List the suites, robots, policies and goals, or the scenarios of a suite."""
    from scenarios.suites.catalog import load_suite

    if suite is None:
        print_names(out)
        return
    print_scenarios(out, load_suite(suite))


def print_names(out: Console) -> None:
    """Print a line for each suite, robot, camera, weather, policy and goal.

    Raises SpecError for the first robot with faults, after all lines.
    """
    from cosim.policies import POLICIES
    from cosim.policies.follow.networks import weights_in_words
    from cosim.policies.follow.policy import Follow
    from cosim.policies.load import bundle_in_words, shipped_bundles
    from cosim.policies.published import NETWORK_POLICIES
    from cosim.policies.published.network_policy import weights_in_words as network_weights
    from cosim.policies.schedule.cheats import CHEATS
    from cosim.results.table import policy_in_words
    from cosim.spec.goal import GOALS
    from cosim.spec.robot import ROBOTS
    from cosim.spec.weather import WEATHERS
    from physics.dynamics.legs.gait_file import weights_in_words as gait_weights_in_words
    from physics.robots.check import check_robot
    from scenarios.suites.catalog import SUITES, load_suite

    for name in SUITES:
        whole = load_suite(name)
        out.print(
            f"suite   {name}  {_counts_in_words(whole)}, version {whole.version}, "
            f"{whole.content_hash}"
        )
    faults = []
    for one in ROBOTS.values():
        try:
            check_robot(one)
        except SpecError as fault:
            faults.append(fault)
            out.print(f"robot   {one.name}  cannot be used: see the error below")
            continue
        size = f"{one.length_m:.2f} x {one.width_m:.2f} m"
        out.print(
            f"robot   {one.name}  {size}, travels at {one.cruise_mps:g} m/s, turns at "
            f"{one.w_max_radps:g} rad/s{gait_weights_in_words(one)}",
            soft_wrap=True,
        )
        for name, mount in one.mounts.items():
            out.print(f"camera  {one.name} {name}  {mount.in_words}", soft_wrap=True)
    for weather in WEATHERS.values():
        out.print(f"weather {weather.name}  {weather.summary}", soft_wrap=True)
    for name, make in POLICIES.items():
        called = policy_in_words(name, make().manifest.privileged)
        out.print(f"policy  {called}  {(make.__doc__ or '').splitlines()[0]}", soft_wrap=True)
    for name, folder in shipped_bundles().items():
        out.print(f"policy  {name}  {bundle_in_words(folder)}", soft_wrap=True)
    about = (Follow.__doc__ or "").splitlines()[0]
    out.print(f"policy  {Follow.manifest.name}  {about} {weights_in_words()}", soft_wrap=True)
    for name, policy in NETWORK_POLICIES.items():
        about = (policy.__doc__ or "").splitlines()[0]
        out.print(f"policy  {name}  {about} {network_weights(policy)}", soft_wrap=True)
    out.print(
        f"policy  schedule:NAME  Drives an open-loop schedule, blind: {', '.join(CHEATS)}",
        soft_wrap=True,
    )
    for goal in GOALS.values():
        out.print(f"goal    {goal.name}  {goal.summary}", soft_wrap=True)
    if faults:
        raise faults[0]


def _counts_in_words(suite: Suite) -> str:
    """Return the number of scenarios of a suite, and how many of them are decoys."""
    decoys = sum(bool(s.decoy_of) for s in suite.scenarios)
    return f"{len(suite.scenarios)} scenarios" + (f" ({decoys} decoys)" if decoys else "")


def print_scenarios(out: Console, suite: Suite) -> None:
    """Print a row per scenario of a suite."""
    columns = [
        *tables.names("scenario"),
        *tables.labels("place"),
        *tables.figures("route\nm", "cross-\nings"),
    ]
    columns += [*tables.labels("events"), *tables.figures("bar-\nriers", "limit\ns")]
    has_decoys = any(s.decoy_of for s in suite.scenarios)
    columns += tables.labels("decoy of") if has_decoys else []
    rows = []
    for s in suite.scenarios:
        events = s.events[0].kind if len(s.events) == 1 else str(len(s.events))
        numbers = (
            f"{s.route_line.length_m:.0f}",
            str(len(s.crossings)),
            events,
            str(len(s.barriers)),
        )
        decoy_of = [s.decoy_of or "-"] if has_decoys else []
        rows.append((s.id, s.place.name, *numbers, f"{s.time_limit_s:.0f}", *decoy_of))
    tables.show(out, columns, rows)


suite_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="The suites that ship, and their proofs.",
)


@suite_app.command(
    "build",
    epilog="Examples:  \n`cosim suite build unit unit.json --jobs 8`  \n"
    "`cosim suite build reactive few.json --only frontal-001 --only static-001`  \n"
    "`cosim suite build reactive redraw-1.json --redraw 1 --only '*-70??' --jobs 2`",
)
def build_one(
    name: Annotated[str, typer.Argument(help="A suite: see `cosim suite list`.")],
    path: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="The suite's file, a .json; its proofs go next to it."),
    ],
    jobs: Annotated[int, typer.Option(min=1, help="Processes, about 0.4 GiB each.")] = 1,
    tries: Annotated[
        int, typer.Option(min=1, help="Candidates of each scenario, until the expert solves one.")
    ] = 6,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Build only this scenario, or those of a pattern such as `*-70??`; repeatable.",
        ),
    ] = None,
    redraw: Annotated[
        int,
        typer.Option(
            min=0,
            max=4000,
            help="Number of a redraw with other seeds, in the same places; 0: the shipped draw.",
        ),
    ] = 0,
) -> None:
    """Draw the scenarios of a suite and prove each solvable. A stopped build continues."""
    from fnmatch import filter as matching

    from scenarios.suites.recipes import RECIPES
    from scenarios.tools.build.build_suite import build_suite

    if name not in RECIPES:
        raise unknown("suite", name, RECIPES)
    names = [slot.name for slot in RECIPES[name].slots]
    wanted: list[str] = []
    for pattern in only or ():
        if not (found := matching(names, pattern)):
            raise unknown("scenario", pattern, names)
        wanted += found

    suite, proofs = build_suite(name, path, jobs, tries, notice, wanted, redraw)
    out.print(
        f"{path}: {len(suite.scenarios)} scenarios, version {suite.version}, {suite.content_hash}",
        soft_wrap=True,
    )
    out.print(
        f"{proofs.first} of {len(proofs.proofs)} first candidates solved by {proofs.expert}",
        highlight=False,
    )
    for reason, count in proofs.dropped.items():
        out.print(f"dropped {count}: {reason}", markup=False, highlight=False)


@suite_app.command(
    "check",
    epilog="Examples:  \n`cosim suite check unit.json --sample 5`  \n`cosim suite check --whole`",
)
def check_suites(
    suites: Annotated[
        list[str] | None, typer.Argument(metavar="[SUITE]...", help="By default all that ship.")
    ] = None,
    sample: Annotated[
        int,
        typer.Option(min=0, help="Scenarios of each structure that are looked at in their places."),
    ] = 3,
    drive: Annotated[
        int, typer.Option(min=0, help="Proofs of each structure that are driven again.")
    ] = 1,
    whole: Annotated[
        bool, typer.Option("--whole", help="Look at all in their places, and drive all proofs.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Processes, about 0.4 GiB each.")] = 1,
) -> None:
    """Prove the claims of suites, such as hashes, single path, gaps and proofs.

    Exit code 1: a claim is false.
    """
    from scenarios.suites.catalog import SUITES

    false = 0
    for name in suites or SUITES:
        false += _false_claims(name, None if whole else sample, None if whole else drive, jobs)
    if false:
        raise typer.Exit(SOME_CRASHED)


def _false_claims(name: str, sample: int | None, drive: int | None, jobs: int) -> int:
    """Print a suite's table and false claims, and return the number of false claims."""
    from scenarios.places.scan_places import lacking_scans
    from scenarios.suites.catalog import SUITES, load_suite
    from scenarios.suites.exploits import read_exploit
    from scenarios.suites.proofs import read_proofs
    from scenarios.suites.recipes import RECIPES
    from scenarios.tools.build.claims import CLAIMS, Read
    from scenarios.tools.build.place_claims import PLACE_CLAIMS, faults_in_places, sample_of
    from scenarios.tools.exploit.check import CLAIM, faults_of_exploit, sample_of_exploit

    suite = load_suite(name)
    path = SUITES.get(name, Path(name))
    if suite.name not in RECIPES:
        raise unknown("suite to check", suite.name, RECIPES)
    try:
        proofs = read_proofs(path)
    except SpecError as error:
        proofs = None
        notice(str(error))
    exploit = read_exploit(path)
    read = Read(suite, proofs, path, exploit)
    faults = {claim: list(of(read)) for claim, of in CLAIMS.items()}
    checked = {claim: len(suite.scenarios) for claim in CLAIMS}
    lacking = lacking_scans(scenario.place for scenario in suite.scenarios)
    for place, remedy in lacking.items():
        notice(f"{name}: '{place}' is not imported, and not looked at: {remedy}")
    every = [s for s in suite.scenarios if s.place.name.removeprefix("map-") not in lacking]
    here = msgspec.structs.replace(suite, scenarios=tuple(every))
    picked = every if sample is None else sample_of(here, sample)
    driven = [s.id for s in (every if drive is None else sample_of(here, drive))]
    extra = [s for s in every if s.id in set(driven) - {s.id for s in picked}]
    with doing(f"looking at {len(picked)} scenarios in their places, driving {len(driven)}"):
        for fault in faults_in_places([*picked, *extra], driven, proofs, jobs):
            faults.setdefault(fault.claim, []).append(fault.words)
    checked |= {claim: len(picked) + len(extra) for claim in PLACE_CLAIMS} | {
        PLACE_CLAIMS[-1]: len(driven)
    }
    if exploit is not None and not faults["exploitability"]:
        again = sample_of_exploit(exploit, drive)
        checked[CLAIM] = len(again)
        with doing(f"driving {len(again)} episodes of blind schedules"):
            for fault in faults_of_exploit(suite, again, jobs):
                faults.setdefault(fault.claim, []).append(fault.words)
    columns = [*tables.names(f"{suite.name} {suite.version}, {suite.content_hash}")]
    columns += tables.figures("looked at", "faults")
    rows = [
        (claim, str(count), f"{len(faults.get(claim, [])) or '-'}")
        for claim, count in checked.items()
    ]
    tables.show(out, columns, rows)
    for claim, found in faults.items():
        for words in found:
            say(f"{suite.name}, {claim}: {words}")
    return sum(bool(found) for found in faults.values())


@suite_app.command("list", epilog="Example:  \n`cosim suite list`")
def list_suites() -> None:
    """List the shipped suites with number of scenarios, version and purpose."""
    from scenarios.suites.catalog import SUITES, load_suite
    from scenarios.suites.recipes import RECIPES

    rows = []
    for name in SUITES:
        suite = load_suite(name)
        test = sum(scenario.split == "test" for scenario in suite.scenarios)
        decoys = sum(bool(scenario.decoy_of) for scenario in suite.scenarios)
        numbers = len(suite.scenarios), len(suite.scenarios) - test, test, decoys
        counts = (*map(str, numbers),)
        rows.append((name, *counts, suite.version, suite.content_hash, RECIPES[name].purpose))
    columns = [*tables.names("suite"), *tables.figures("scenarios", "val", "test", "decoys")]
    columns += [*tables.labels("version", "hash"), *tables.words("for")]
    tables.show(out, columns, rows)
