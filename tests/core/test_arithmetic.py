"""What is recorded of a machine's arithmetic."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.core.arithmetic import arithmetic
from cosim.core.versions import versions

FLAGS = set(Path("/proc/cpuinfo").read_text().split())
ELSEWHERE = {
    "C-library": ("fma", {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2_Usable,-FMA_Usable,-AVX2"}),
    "numpy": ("avx512f", {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}),
}
"""What makes the packages of this machine compute as on one whose processor lacks a feature that this one has."""


def told(**environment: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", "from cosim.core.arithmetic import arithmetic as a; print(a())"]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=True).stdout


def test_a_machine_always_tells_the_same() -> None:
    """Every process of it, and every record."""
    assert told().strip() == arithmetic() == versions()["arithmetic"]


@pytest.mark.parametrize("library", ELSEWHERE)
def test_a_machine_that_rounds_otherwise_tells_something_else(library: str) -> None:
    """The same packages, another processor: sines of other bits, and episodes of other bits."""
    flag, environment = ELSEWHERE[library]
    if flag not in FLAGS:
        pytest.skip(f"this processor has no {flag} that could be left out")
    assert told(**environment).strip() != arithmetic()
