"""Run netconvert, which builds street nets, and report its failures as one-line MapErrors."""

from __future__ import annotations

import os
import selectors
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from cosim.core.errors import MachineError, MapError

MESSAGE_CHARS = 400
"""Largest number of characters of netconvert's messages in an error."""
_STAGES: Final = (
    (b"Parsing nodes", 0.0),
    (b"Parsing edges", 0.02),
    (b"Removing self-loops", 0.11),
    (b"Joining junction clusters", 0.23),
    (b"Moving network to origin", 0.27),
    (b"Guessing and setting on-/off-ramps", 0.34),
    (b"Computing node shapes", 0.41),
    (b"Computing edge shapes", 0.48),
    (b"Computing priorities", 0.53),
    (b"Computing approaching lanes", 0.55),
    (b"Rechecking of lane endings", 0.59),
    (b"Computing node logics", 0.64),
    (b"Building inner edges", 0.66),
    (b"Writing network", 0.75),
)
"""Output of netconvert at the start of each stage, and the share of its run time before it,
measured on a city."""


def sumo_home() -> Path:
    """Return the folder of the installed SUMO package."""
    import sumo

    return Path(sumo.__file__).parent


def netconvert(
    arguments: Sequence[str],
    output: Path,
    timeout_s: float = 120.0,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Run netconvert to build `output`, and return `output`.

    progress: called with the share that is done, 0 to 1, at the start of each stage.

    Raises MapError with netconvert's messages, MachineError if it cannot be run.
    """
    command = [str(sumo_home() / "bin" / "netconvert"), *arguments, "-o", str(output)]
    try:
        returncode, messages = _run(
            command if progress is None else [*command, "--verbose"], timeout_s, progress
        )
    except subprocess.TimeoutExpired as error:
        raise MapError(
            f"netconvert did not end within {timeout_s:g} s: cut the area of interest out first"
        ) from error
    except OSError as error:
        raise MachineError(
            f"netconvert cannot be run: {error.strerror}: is eclipse-sumo installed?"
        ) from error
    if returncode != 0 or not output.exists():
        raise MapError(f"netconvert failed with exit code {returncode}{error_summary(messages)}")
    # netconvert also returns 0 for an empty net.
    if b"<edge " not in output.read_bytes():
        raise MapError(f"netconvert made a net without any edge{error_summary(messages)}")
    return output


def _run(
    command: Sequence[str], timeout_s: float, progress: Callable[[float], None] | None
) -> tuple[int, str]:
    """Run a command and return its exit code and standard error."""
    began = time.monotonic()
    with tempfile.TemporaryFile() as errors, selectors.DefaultSelector() as ready:
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors
        ) as process:
            assert process.stdout is not None
            ready.register(process.stdout, selectors.EVENT_READ)
            recent = b""
            try:
                while ready.select(max(began + timeout_s - time.monotonic(), 0.0)):
                    chunk = os.read(process.stdout.fileno(), 1 << 16)
                    if not chunk:
                        break
                    # The start of a stage may be split between two reads.
                    recent = recent[-80:] + chunk
                    begun = [share for words, share in _STAGES if words in recent]
                    if progress is not None and begun:
                        progress(max(begun))
                process.wait(max(began + timeout_s - time.monotonic(), 0.0))
            except BaseException:
                process.kill()
                raise
        errors.seek(0)
        return process.returncode, errors.read().decode(errors="replace")


def error_summary(output: str) -> str:
    """Summarize the messages of a SUMO program in one line: its errors, or its last line."""
    lines = [" ".join(line.split()) for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if not line.startswith(("Warning", "Quitting"))]
    summary = "; ".join(
        dict.fromkeys(line.removeprefix("Error: ") for line in errors or lines[-1:])
    )
    return (
        f": {summary[:MESSAGE_CHARS]}{' ...' if len(summary) > MESSAGE_CHARS else ''}"
        if summary
        else ""
    )
