"""The arithmetic fingerprint of a machine in records, and numpy without AVX-512."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.core.versions import arithmetic, versions

FLAGS = set(Path("/proc/cpuinfo").read_text().split())
WITHOUT_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2_Usable,-FMA_Usable,-AVX2"}
PRINT_FINGERPRINT = "from cosim.core.versions import arithmetic as a; print(a())"


def fingerprint(program: str = PRINT_FINGERPRINT, **environment: str) -> str:
    command = [sys.executable, "-W", "ignore", "-c", program]
    return subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=True
    ).stdout


def test_a_machine_always_has_the_same_fingerprint() -> None:
    """Every process of a machine, and every record, has the same fingerprint."""
    assert fingerprint().strip() == arithmetic() == versions()["arithmetic"]


def test_a_processor_without_fused_multiply_add_has_another_fingerprint() -> None:
    """The same packages with a C library without FMA give sines, and so episodes, of other bits."""
    if "fma" not in FLAGS:
        pytest.skip("this processor has no fma that could be left out")
    assert fingerprint(**WITHOUT_FMA).strip() != arithmetic()


def test_numpy_with_avx512_has_another_fingerprint() -> None:
    """Where numpy is loaded before cosim, with AVX-512, its sines have other bits."""
    if "avx512f" not in FLAGS:
        pytest.skip("this processor has no AVX-512")
    assert (
        fingerprint("import numpy; " + PRINT_FINGERPRINT, NPY_DISABLE_CPU_FEATURES="").strip()
        != arithmetic()
    )


_FEATURES = "from numpy._core._multiarray_umath import __cpu_features__ as f; print(f['X86_V4'])"


def _run(program: str) -> subprocess.CompletedProcess[str]:
    clean = {"PYTHONPATH": ":".join(sys.path)}
    return subprocess.run(
        [sys.executable, "-c", program], env=clean, capture_output=True, text=True, check=True
    )


@pytest.mark.parametrize(
    "room",
    [
        "cosim",
        "scenarios.suites.user_scenarios.read",
        "physics.robots",
        "sumo_nets.city",
        "bridge.codec",
    ],
)
def test_every_package_loads_numpy_without_avx512(room: str) -> None:
    """Whichever package of the project a program imports first, numpy computes without AVX-512."""
    assert _run(f"import {room}; {_FEATURES}").stdout == "False\n"


def test_a_program_that_loads_numpy_first_is_warned() -> None:
    """The warning says that numpy computes with AVX-512, and what to do."""
    if _run(_FEATURES).stdout == "False\n":
        pytest.skip("this processor has no AVX-512")
    assert "Import cosim first" in _run("import numpy, cosim").stderr
    assert "AVX-512" not in _run("import cosim, numpy").stderr


def test_features_that_the_user_disables_stay_disabled() -> None:
    """Features of numpy that the environment already disables remain disabled."""
    program = "import os; os.environ['NPY_DISABLE_CPU_FEATURES'] = 'X86_V3, X86_V4'; import cosim; "
    assert _run(program + "print(os.environ['NPY_DISABLE_CPU_FEATURES'])").stdout.startswith(
        "X86_V3 X86_V4 "
    )
