"""What is recorded of a machine's arithmetic."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.core.versions import arithmetic, versions

FLAGS = set(Path("/proc/cpuinfo").read_text().split())
WITHOUT_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2_Usable,-FMA_Usable,-AVX2"}
TELLS = "from cosim.core.versions import arithmetic as a; print(a())"


def told(program: str = TELLS, **environment: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", program]
    return subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=True
    ).stdout


def test_a_machine_always_tells_the_same() -> None:
    """Every process of it, and every record."""
    assert told().strip() == arithmetic() == versions()["arithmetic"]


def test_a_processor_without_fused_multiply_add_tells_something_else() -> None:
    """The same packages, a C library that goes without: sines of other bits, and episodes of other
    bits."""
    if "fma" not in FLAGS:
        pytest.skip("this processor has no fma that could be left out")
    assert told(**WITHOUT_FMA).strip() != arithmetic()


def test_numpy_with_avx512_tells_something_else() -> None:
    """Where numpy is loaded before cosim, and so with AVX-512, its sines have other bits."""
    if "avx512f" not in FLAGS:
        pytest.skip("this processor has no AVX-512")
    assert told("import numpy; " + TELLS, NPY_DISABLE_CPU_FEATURES="").strip() != arithmetic()
