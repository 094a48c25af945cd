"""The command line of an installation: `cosim doctor`, `cosim verify`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape

from cosim.cli.terminal.consoles import err, out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import BROKEN_MACHINE, SOME_CRASHED, EngineError, unknown

installation_app = typer.Typer()
_LACKING = "an engine cannot be loaded: {}. Mend what it names, or set up anew"


@installation_app.command(epilog="Example:  \n`cosim doctor`")
def doctor() -> None:
    """Check that every engine works here: versions, a frame, a query, a step."""
    try:
        from scenarios.checks import CHECKS
    except (ImportError, OSError) as error:
        raise EngineError(_LACKING.format(error)) from error

    failed = 0
    for name, check in CHECKS.items():
        try:
            out.print(f"[green]ok[/]      {name}: {check()}", soft_wrap=True)
        except Exception as error:  # noqa: BLE001  a check may fail in any way; it is shown and counted
            failed += 1
            out.print(f"[red]failed[/]  {name}: {type(error).__name__}: {escape(str(error))}", soft_wrap=True)
    if failed:
        raise typer.Exit(BROKEN_MACHINE)


@installation_app.command(epilog="Examples:  \n`cosim verify`  \n`cosim verify --case lh-001-00 --case frontal-001`")
def verify(
    case: Annotated[list[str] | None, typer.Option(help="Only this case; may be repeated.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes; with 1 all runs in this one.")] = 2,
    write: Annotated[
        bool, typer.Option("--write", help="Take what comes out here as what is shipped, after suites were built anew.")
    ] = False,
) -> None:
    """Does this installation give the shipped bits and numbers? If not: which engine, version or part, and the remedy.

    Runs the beginnings of 12 scenarios, of each suite the first of each structure or event, with the oracle, and draws
    a picture of each by both cameras. An OpenGL driver that is not that of the shipped pictures may differ a little.
    """
    try:
        from scenarios.verifying.cases import verified_cases
        from scenarios.verifying.shipped import SHIPPED, Given, given_here, writable
        from scenarios.verifying.verdict import blamed, findings
    except (ImportError, OSError) as error:
        raise EngineError(_LACKING.format(error)) from error

    cases = {one.id: one for one in verified_cases()}
    for name in case or ():
        if name not in cases:
            raise unknown("case", name, cases)
    picked = [cases[name] for name in dict.fromkeys(case or cases)]
    shipped = None if write else Given.load(SHIPPED)
    with doing(f"running {len(picked)} cases") as tell:
        here = given_here(picked, jobs, tell)
    if shipped is None:
        writable(here, list(cases)).save(SHIPPED)
        out.print(f"{SHIPPED}: {len(here.traces)} cases", soft_wrap=True, highlight=False)
        return
    found = list(findings(shipped, here))
    for one in found:
        mark = "[green]ok[/]     " if one.fine else "[red]differs[/]"
        out.print(f"{mark} {escape(one.name)}: {escape(one.words)}", soft_wrap=True, highlight=False)
    wrong = [one for one in found if not one.fine]
    for words in blamed(wrong, shipped, here):
        err.print(words, soft_wrap=True, highlight=False, markup=False)
    if wrong:
        err.print(f"{len(wrong)} of {len(found)} differ: this is not the installation that was shipped.")
        raise typer.Exit(SOME_CRASHED)
    out.print("This installation gives the shipped bits and numbers.")
