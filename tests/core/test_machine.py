"""Missing parts of a machine are reported, or installed, before anything is set up or started."""

from __future__ import annotations

import ast
import mmap
import os
import re
import shutil
import struct
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from cosim.machine import (
    EXIT_CODE,
    FOR_PICTURES,
    LIBRARIES,
    Machine,
    check_machine,
    missing,
    refusal,
)
from tests.conftest import PATIENCE_S

ROOT = Path(__file__).parents[2]
GLIBC = {
    "ld-linux-aarch64.so.1",
    "ld-linux-x86-64.so.2",
    "libc.so.6",
    "libdl.so.2",
    "libm.so.6",
    "libmvec.so.1",
    "libpthread.so.0",
    "libresolv.so.2",
    "librt.so.1",
}
ENGINES = ("libsumo", "pybullet", "zenoh", "moderngl", "numpy", "scenarios")


class FakeMachine(Machine):
    """A machine without these packages, whose apt-get has those of `archive`."""

    def __init__(self, *without: str, root: bool = False, archive: tuple[str, ...] = ()) -> None:
        self.without = set(without)
        self.root = root
        self.archive = archive
        self.installed: list[str] = []

    def loads(self, library: str) -> bool:
        return {**LIBRARIES, **FOR_PICTURES}[library] not in self.without

    def runs(self, python: str) -> str:
        return f"there is no '{python}'" if "python3.11" in self.without else ""

    def can_install(self) -> bool:
        return self.root

    def install(self, packages: list[str]) -> None:
        self.installed += packages
        if set(packages) <= set(self.archive):
            self.without -= set(packages)


def test_each_missing_library_is_named_with_its_package() -> None:
    """A refusal names every missing library, its package, and one command that installs them
    all."""
    message = refusal(FakeMachine("libx11-6", "libatomic1", "libegl1"))
    assert "libX11.so.6 (package libx11-6), libatomic.so.1 (package libatomic1)" in message
    assert (
        message.endswith("install -y --no-install-recommends libx11-6 libatomic1 libegl1")
        and "\n" not in message
    )
    assert refusal(FakeMachine()) == ""


def test_without_root_the_check_reports_and_stops(capsys: pytest.CaptureFixture[str]) -> None:
    """Without the right to install, the check reports what is missing and exits with 3, and nothing
    is installed."""
    machine = FakeMachine("libx11-6", "python3.11")
    assert (
        check_machine(["--install", "--python", "python3.11"], machine) == EXIT_CODE
        and machine.installed == []
    )
    message = capsys.readouterr().err
    assert (
        "lacks Python 3.11 with venv (there is no 'python3.11') and libX11.so.6 (package libx11-6)."
        in message
    )
    assert "python3.11 python3.11-venv libx11-6\n" in message and "make PYTHON=" in message


def test_root_installs_exactly_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    """As root on Debian exactly the missing packages are installed and reported; a second check
    does nothing."""
    archive = ("libx11-6", "libegl1", "python3.11", "python3.11-venv")
    machine = FakeMachine("libx11-6", "libegl1", "python3.11", root=True, archive=archive)
    assert check_machine(["--install"], machine) == 0
    assert machine.installed == ["python3.11", "python3.11-venv", "libx11-6", "libegl1"]
    assert "lacks libx11-6, libegl1: apt-get installs exactly that" in capsys.readouterr().err
    assert check_machine(["--install"], machine) == 0 and len(machine.installed) == 4
    assert capsys.readouterr().err == ""


def test_a_package_missing_from_the_archive_stops_root_too(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Where apt-get has no Python 3.11, the libraries are installed and the rest is reported."""
    machine = FakeMachine("libx11-6", "python3.11", root=True, archive=("libx11-6",))
    assert check_machine(["--install"], machine) == EXIT_CODE and missing(machine) == []
    assert "error: this machine lacks Python 3.11" in capsys.readouterr().err


def test_a_missing_egl_is_no_error(capsys: pytest.CaptureFixture[str]) -> None:
    """Only pictures need EGL, so its absence is reported in one line."""
    assert check_machine([], FakeMachine("libegl1")) == 0
    message = capsys.readouterr().err
    assert message.startswith("note: no libEGL.so.1") and message.count("\n") == 1
    assert refusal(FakeMachine("libegl1")) == ""


@pytest.mark.parametrize(
    "script, wrong",
    [
        ("echo 3.12", "is Python 3.12"),
        ("echo 3.11; exit 1", "has no venv and ensurepip"),
        ("exit 127", "does not run"),
        ("echo 3.11", ""),
    ],
    ids=["newer", "no-venv", "broken", "good"],
)
def test_the_python_of_the_environment_is_checked(script: str, wrong: str, tmp_path: Path) -> None:
    """The interpreter that will create the environment is run, and its faults are reported."""
    python = tmp_path / "python3.11"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(0o755)
    assert Machine().runs(str(python)) == (wrong and f"'{python}' {wrong}")
    assert Machine().runs(str(tmp_path / "none")) == f"there is no '{tmp_path / 'none'}'"


@pytest.mark.parametrize("verb", ["run", "test", "check", "docs", "bench"])
def test_make_checks_the_machine_before_it_sets_up(verb: str, tmp_path: Path) -> None:
    """Every make target that needs the packages checks the machine first and stops with one error."""
    make = shutil.which("make")
    assert make is not None
    locks = (path.name for path in ROOT.glob("requirements*.lock"))
    for name in ("Makefile", "pyproject.toml", *locks, "cosim/machine.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    python = tmp_path / "python3.12"
    python.write_text(
        f'#!/bin/sh\ncase "$*" in *-c*) echo 3.12;; *) exec {sys.executable} "$@";; esac\n'
    )
    python.chmod(0o755)
    before = sorted(tmp_path.rglob("*"))
    nothing_to_install_with = {"PATH": str(tmp_path)}
    command = [make, "-j4", verb, f"PYTHON={python}"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, env=nothing_to_install_with
    )
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("error: ") == 1
    assert f"lacks Python 3.11 with venv ('{python}' is Python 3.12)" in done.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_make_without_any_python_names_the_package(tmp_path: Path) -> None:
    """On a machine without Python, make names the package and stops."""
    make = shutil.which("make")
    assert make is not None
    shutil.copy(ROOT / "Makefile", tmp_path)
    done = subprocess.run(
        [make, "run"], cwd=tmp_path, capture_output=True, text=True, env={"PATH": str(tmp_path)}
    )
    assert (
        done.returncode == 2
        and "there is no python3.11. On Debian, as root: apt-get install" in done.stderr
    )
    assert [path.name for path in tmp_path.iterdir()] == ["Makefile"]


def test_a_library_is_looked_for_by_the_loader(monkeypatch: pytest.MonkeyPatch) -> None:
    """A common library is found, an impossible one is not, and one with a missing dependency is not
    blamed."""
    assert Machine().loads("libc.so.6") and not Machine().loads("libcosim-has-none.so.9")

    def load(name: str) -> None:
        raise OSError("libX11.so.6: cannot open shared object file: No such file or directory")

    monkeypatch.setattr("ctypes.CDLL", load)
    assert Machine().loads("libXext.so.6") and not Machine().loads("libX11.so.6")


def test_the_check_runs_before_anything_is_installed() -> None:
    """The check parses with Python 3.8, imports the standard library only, and runs without
    site-packages."""
    source = (ROOT / "cosim/machine.py").read_text()
    tree = ast.parse(source, feature_version=(3, 8))
    imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    imported |= {n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert imported <= sys.stdlib_module_names
    here = {**os.environ, "PATH": ""}
    command = [sys.executable, "-I", "-S", str(ROOT / "cosim/machine.py"), "--python", "/none"]
    done = subprocess.run(command, capture_output=True, text=True, env=here)
    assert (
        done.returncode == EXIT_CODE
        and "there is no '/none'" in done.stderr
        and "Traceback" not in done.stderr
    )


@pytest.mark.parametrize(
    "words", [["doctor"], ["run", "long-horizon", "--out", "out"]], ids=["doctor", "run"]
)
def test_the_command_line_reports_it_before_it_loads_an_engine(
    words: list[str], tmp_path: Path
) -> None:
    """Without libX11 `cosim doctor` and `cosim run` end at once with one line and exit code 3."""
    code = (
        "import atexit, ctypes, sys\nreal = ctypes.CDLL\ndef load(name, *rest, **more):\n    if "
        "'X11' in str(name): raise OSError(f'{name}: cannot open shared object file')\n    "
        "return real(name, *rest, **more)\nctypes.CDLL = load\natexit.register(lambda: "
        f"print(sorted(set({ENGINES!r}) & set(sys.modules))))\nsys.argv = ['cosim', "
        f"*{words!r}]\nfrom cosim.__main__ import main\nmain()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 3 and done.stdout.strip() == "[]"
    assert done.stderr.startswith("error: this machine lacks libX11.so.6 (package libx11-6). ")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["typer", "zenoh"], ids=["front", "engine"])
def test_a_package_that_cannot_be_imported_is_reported_in_one_line(module: str) -> None:
    """Where a package is missing or broken, `cosim doctor` names it and ends with exit code 3,
    without a traceback."""
    code = f"import sys; sys.modules[{module!r}] = None; sys.argv = ['cosim', 'doctor']\n"
    code += "from cosim.__main__ import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 3 and done.stdout == ""
    assert (
        done.stderr.startswith("error: ") and module in done.stderr and done.stderr.count("\n") == 1
    )


def test_the_table_holds_every_library_that_the_packages_load() -> None:
    """Each library that the locked packages need is in glibc, in the packages themselves, or in the
    table."""
    locked = re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    files = [Path(str(f.locate())) for name in locked for f in distribution(name).files or ()]
    files = [
        path
        for path in files
        if (".so" in path.name or path.parent.name == "bin") and path.is_file()
    ]
    brought = {path.name for path in files}
    needed = {library for path in files for library in needed_by(path)}
    assert len(needed) > 50 and needed - brought - GLIBC == set(LIBRARIES)


def needed_by(path: Path) -> list[str]:
    """Return the DT_NEEDED entries of a 64-bit little-endian ELF file, and none for other files."""
    if path.stat().st_size < 64:
        return []
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
        if raw[:6] != b"\x7fELF\x02\x01":
            return []
        (start,) = struct.unpack_from("<Q", raw, 32)
        (size, count) = struct.unpack_from("<HH", raw, 54)
        parts = [struct.unpack_from("<IIQQQQQQ", raw, start + i * size) for i in range(count)]
        dynamic = next((part for part in parts if part[0] == 2), None)
        if dynamic is None:
            return []
        tags = list(struct.iter_unpack("<QQ", raw[dynamic[2] : dynamic[2] + dynamic[5] // 16 * 16]))
        strings = next(value for tag, value in tags if tag == 5)
        within = next(
            part for part in parts if part[0] == 1 and part[3] <= strings < part[3] + part[5]
        )
        table = strings - within[3] + within[2]
        names = [table + value for tag, value in tags if tag == 1]
        return [raw[at : raw.find(b"\0", at)].decode() for at in names]
