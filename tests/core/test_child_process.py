"""Forked child processes."""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import PATIENCE_S

INTERRUPTED = """
import os, signal
from cosim.core.child_process import ForkedChild

def waits(wire):
    wire.receive()

os.register_at_fork(after_in_parent=lambda: os.kill(os.getpid(), signal.SIGINT))
try:
    ForkedChild(waits, 1 << 30).wire.receive()
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_during_a_fork_is_not_lost() -> None:
    """A process that is interrupted while it forks raises KeyboardInterrupt."""
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.stdout == "interrupted\n", done.stderr
