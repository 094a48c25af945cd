"""`--rerun FILE.rrd`: one episode as a recording for the Rerun viewer."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from cosim.cli.options.output_file import check_output, replaced
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing
from cosim.core.errors import MachineError, UsageError

RERUN_HELP = "Write one episode as a recording for the Rerun viewer (package extra [rerun]): it is replayed for that."


def check_rerun(path: Path | None, episodes: int) -> None:
    """Before anything runs, where a recording is asked for: raises UsageError for a name that is none, or several
    episodes, MachineError without the package."""
    if path is None:
        return
    check_output(path, "a Rerun recording", (".rrd",))
    if episodes != 1:
        how = "--scenario of `cosim run`, --episode of `cosim show`"
        raise UsageError(f"--rerun is of one episode, and {episodes or 'none'} are asked for: name one ({how})")
    if importlib.util.find_spec("rerun") is None:
        raise MachineError("--rerun needs rerun-sdk, of the extra [rerun]: pip install 'sidewalk-cosim[rerun]'")


def write_rerun(folder: Path, episodes: list[str], path: Path | None) -> None:
    """Write the recording of the one episode of a run, where it is asked for, and say so."""
    check_rerun(path, len(episodes))
    if path is None:
        return
    from scenarios.viewing.rerun_file import record_for_rerun

    instead = replaced(path)
    with doing(f"recording {episodes[0]}") as tell:
        record_for_rerun(folder, episodes[0], path, tell=tell)
    size = f"{path.stat().st_size / 1e6:.1f} MB, the state hash is the record's"
    out.print(f"Recording: {path} ({size}){instead}. Open it with: rerun {path}", soft_wrap=True, highlight=False)
