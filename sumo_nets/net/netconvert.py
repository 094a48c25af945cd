"""netconvert, the program that makes street nets, with its failures as MapError of one line."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

from cosim.core.errors import MachineError, MapError

WORDS = 400
"""So many letters of netconvert's complaints are told."""


def netconvert(arguments: Sequence[str], output: Path, timeout_s: float = 120.0) -> Path:
    """Run netconvert to make `output`. Raises MapError with its complaints, MachineError when it cannot be run."""
    import sumo

    command = [str(Path(sumo.__file__).parent / "bin" / "netconvert"), *arguments, "-o", str(output)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise MapError(f"netconvert did not end within {timeout_s:g} s: cut the area of interest out first") from error
    except OSError as error:
        raise MachineError(f"netconvert cannot be run: {error.strerror}: is eclipse-sumo installed?") from error
    if done.returncode != 0 or not output.exists():
        raise MapError(f"netconvert failed with exit code {done.returncode}{complaints(done.stderr)}")
    # An exit code of 0 is no proof: an empty net ends in "Success" too.
    if b"<edge " not in output.read_bytes():
        raise MapError(f"netconvert made a net without any edge{complaints(done.stderr)}")
    return output


def complaints(said: str) -> str:
    """What a program of SUMO says of its failure, on one line: its errors, its last words where it names none."""
    lines = [" ".join(line.split()) for line in said.splitlines() if line.strip()]
    errors = [line for line in lines if not line.startswith(("Warning", "Quitting"))]
    words = "; ".join(dict.fromkeys(line.removeprefix("Error: ") for line in errors or lines[-1:]))
    return f": {words[:WORDS]}{' ...' if len(words) > WORDS else ''}" if words else ""
