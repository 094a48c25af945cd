"""The command line of suites: `cosim suite build`, `check`, `list`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.table import Table

from cosim.cli.terminal.consoles import err, out
from cosim.cli.terminal.fitted import print_fitted
from cosim.cli.terminal.progress import doing
from cosim.core.errors import SOME_CRASHED, SpecError, unknown

suite_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="The suites that ship, and their proofs."
)


@suite_app.command(
    "build",
    epilog="Examples:  \n`cosim suite build unit unit.json --jobs 8`  \n"
    "`cosim suite build reactive few.json --only frontal-001 --only static-001`",
)
def build_one(
    name: Annotated[str, typer.Argument(help="A suite: see `cosim suite list`.")],
    path: Annotated[Path, typer.Argument(metavar="OUT", help="The suite's file, a .json; its proofs go beside it.")],
    jobs: Annotated[int, typer.Option(min=1, help="Processes, about 0.4 GiB each.")] = 1,
    tries: Annotated[int, typer.Option(min=1, help="Candidates of each scenario, until the expert solves one.")] = 6,
    only: Annotated[list[str] | None, typer.Option(help="Build only this scenario; may be repeated.")] = None,
) -> None:
    """Draw the scenarios of a suite and prove each solvable. Stopped, it goes on where it was when called again."""
    from scenarios.builders.building import build_suite
    from scenarios.builders.recipes import RECIPES

    if name not in RECIPES:
        raise unknown("suite", name, RECIPES)
    names = {slot.name for slot in RECIPES[name].slots}
    for one in only or ():
        if one not in names:
            raise unknown("scenario", one, names)

    def tell(line: str, done: int, count: int) -> None:
        err.print(f"{done}/{count} {line}", soft_wrap=True, markup=False, highlight=False)

    suite, proofs = build_suite(name, path, jobs, tries, tell, only or ())
    out.print(
        f"{path}: {len(suite.scenarios)} scenarios, version {suite.version}, {suite.content_hash}", soft_wrap=True
    )
    out.print(f"{proofs.first} of {len(proofs.proofs)} first candidates solved by {proofs.expert}", highlight=False)
    for reason, count in proofs.dropped.items():
        out.print(f"dropped {count}: {reason}", markup=False, highlight=False)


@suite_app.command(
    "check",
    epilog="Examples:  \n`cosim suite check unit.json --sample 5`  \n`cosim suite check --whole`",
)
def check_suites(
    suites: Annotated[list[str] | None, typer.Argument(metavar="[SUITE]...", help="By default all that ship.")] = None,
    sample: Annotated[
        int, typer.Option(min=0, help="Scenarios of each structure that are looked at in their places.")
    ] = 3,
    drive: Annotated[int, typer.Option(min=0, help="Proofs of each structure that are driven again.")] = 1,
    whole: Annotated[bool, typer.Option("--whole", help="Look at all in their places, and drive all proofs.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Processes, about 0.4 GiB each.")] = 1,
) -> None:
    """Prove what suites claim: counts, hashes, single path, gaps, spread, no duplicates, proofs. Exit code 1: one
    claim is false."""
    from scenarios.catalog import SUITES

    false = 0
    for name in suites or SUITES:
        false += _checked(name, None if whole else sample, None if whole else drive, jobs)
    if false:
        raise typer.Exit(SOME_CRASHED)


def _checked(name: str, sample: int | None, drive: int | None, jobs: int) -> int:
    """Print a suite's table, and what is false. Returns how many claims are."""
    from scenarios.builders.claims import CLAIMS, Read
    from scenarios.builders.place_claims import PLACE_CLAIMS, faults_in_places, sample_of
    from scenarios.builders.proofs import read_proofs
    from scenarios.builders.recipes import RECIPES
    from scenarios.catalog import SUITES, load_suite

    suite, path = load_suite(name), SUITES.get(name, Path(name))
    if suite.name not in RECIPES:
        raise unknown("suite to check", suite.name, RECIPES)
    try:
        proofs = read_proofs(path)
    except SpecError as error:
        proofs = None
        err.print(str(error), soft_wrap=True, markup=False, highlight=False)
    read = Read(suite, proofs, path)
    faults = {claim: list(of(read)) for claim, of in CLAIMS.items()}
    looked = {claim: len(suite.scenarios) for claim in CLAIMS}
    all_there = list(suite.scenarios)
    picked = all_there if sample is None else sample_of(suite, sample)
    driven = [s.id for s in (all_there if drive is None else sample_of(suite, drive))]
    extra = [s for s in all_there if s.id in set(driven) - {s.id for s in picked}]
    with doing(f"looking at {len(picked)} scenarios in their places, driving {len(driven)}"):
        for fault in faults_in_places([*picked, *extra], driven, proofs, jobs):
            faults.setdefault(fault.claim, []).append(fault.words)
    looked |= {claim: len(picked) + len(extra) for claim in PLACE_CLAIMS} | {PLACE_CLAIMS[-1]: len(driven)}
    table = Table(f"{suite.name} {suite.version}, {suite.content_hash}", "looked at", "faults", box=box.SIMPLE_HEAD)
    for claim, count in looked.items():
        found = faults.get(claim, [])
        table.add_row(claim, str(count), str(len(found)) if found else "-")
    print_fitted(out, table)
    for claim, words in ((claim, words) for claim, found in faults.items() for words in found):
        out.print(f"{suite.name}, {claim}: {words}", soft_wrap=True, markup=False, highlight=False)
    return sum(bool(found) for found in faults.values())


@suite_app.command("list", epilog="Example:  \n`cosim suite list`")
def list_suites() -> None:
    """List the suites that ship: how many scenarios, of which version, and what they are for."""
    from scenarios.builders.recipes import RECIPES
    from scenarios.catalog import SUITES, load_suite

    table = Table("suite", "scenarios", "val", "test", "version", "hash", "for", box=box.SIMPLE_HEAD)
    for name in SUITES:
        suite = load_suite(name)
        test = sum(scenario.split == "test" for scenario in suite.scenarios)
        counts = (str(len(suite.scenarios)), str(len(suite.scenarios) - test), str(test))
        table.add_row(name, *counts, suite.version, suite.content_hash, RECIPES[name].purpose)
    print_fitted(out, table, words=[6])
