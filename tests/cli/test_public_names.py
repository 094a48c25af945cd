"""The public interface of `import cosim`: names, import cost, and documentation."""

from __future__ import annotations

import doctest
import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

import cosim

ROOT = Path(__file__).parents[2]
DRIVES = ("Episode", "make_env", "run")
"""Public names whose example drives a robot."""
PRODUCT = ("cosim", "sumo_nets", "physics", "bridge", "scenarios")


def test_importing_cosim_imports_nothing_but_the_standard_library() -> None:
    """A new process that imports cosim has loaded one file of the project and no other package."""
    result = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; old = set(sys.modules); import cosim; print(*set(sys.modules) - old)",
        ],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    ).stdout.split()
    strangers = {name.split(".")[0] for name in result} - set(sys.stdlib_module_names) - {"cosim"}
    assert not strangers and {n for n in result if n.startswith("cosim")} == {
        "cosim",
        "cosim.rounding",
    }


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.engine] * (name in DRIVES)) for name in cosim.__all__],
)
def test_the_example_of_every_public_name_is_correct(name: str) -> None:
    """Every name of `__all__` is documented with an example whose output is correct."""
    value = getattr(cosim, name)
    (shown,) = doctest.DocTestFinder(recurse=False).find(
        value, name, globs=vars(sys.modules[value.__module__]).copy()
    )
    assert shown.examples
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL)
    output = io.StringIO()
    runner.run(shown, out=output.write)
    assert not runner.failures, output.getvalue()


def test_an_unknown_name_is_refused_with_the_valid_ones() -> None:
    """A misspelt name is an AttributeError that lists the valid ones."""
    with pytest.raises(AttributeError, match=r"no attribute 'Epsiode'.*Episode"):
        cosim.Epsiode  # noqa: B018  the access is the test


def test_the_crowd_is_created_in_one_file() -> None:
    """Exactly one module connects SUMO's crowd to episodes."""
    files = [path for top in PRODUCT for path in (ROOT / top).rglob("*.py")]
    calls = [
        str(p.relative_to(ROOT))
        for p in files
        if re.search(r"(?<!class )\bSumoCrowd\(", p.read_text())
    ]
    assert calls == ["scenarios/episodes/wiring.py"]
