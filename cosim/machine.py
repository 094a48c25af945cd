"""Check this machine for Python 3.11 with venv and the shared libraries that wheels do not bring.

It runs before anything is installed, with any Python 3: `python3 -I cosim/machine.py --install`. So
it imports only the standard library. `make` runs it first, `cosim` at each start.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import sys

EXIT_CODE = 3
"""Exit code when the machine lacks something."""
LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
    "libatomic.so.1": "libatomic1",
    "libexpat.so.1": "libexpat1",
    "libz.so.1": "zlib1g",
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
}
"""Shared libraries that the wheels load, and their Debian packages. SUMO needs the first five."""
FOR_PICTURES = {"libEGL.so.1": "libegl1"}
"""Further library of the gl camera, and its Debian package, which includes Mesa's driver."""
PYTHON = ("python3.11", "python3.11-venv")
"""Debian packages of the Python that the project needs."""


class Machine:
    """Access to this machine for the check; tests replace it."""

    def loads(self, library: str) -> bool:
        """Return whether the dynamic loader can open a library.

        A library that fails only because of another one in the tables counts as loadable: that
        other one is reported.
        """
        try:
            ctypes.CDLL(library)
        except OSError as error:
            blamed = str(error).partition(":")[0]
            return blamed != library and blamed in {**LIBRARIES, **FOR_PICTURES}
        return True

    def runs(self, python: str) -> str:
        """Return the problem with a Python interpreter, or ""."""
        ask = "import sys; print(*sys.version_info[:2], sep='.'); import venv, ensurepip"
        try:
            said = subprocess.run([python, "-I", "-c", ask], capture_output=True)
        except OSError:
            return f"there is no '{python}'"
        version = said.stdout.decode(errors="replace").strip()
        if version and version != "3.11":
            return f"'{python}' is Python {version}"
        if said.returncode != 0:
            return (
                f"'{python}' has no venv and ensurepip" if version else f"'{python}' does not run"
            )
        return ""

    def can_install(self) -> bool:
        """Return whether this process is root on a system with apt-get."""
        return os.geteuid() == 0 and shutil.which("apt-get") is not None

    def install(self, packages: list[str]) -> None:
        """Install packages with apt-get and show its output. The caller checks the result."""
        environment = dict(os.environ, DEBIAN_FRONTEND="noninteractive")
        for command in (["update"], ["install", "-y", "--no-install-recommends", *packages]):
            subprocess.run(
                ["apt-get", "-q", *command],
                env=environment,
                stdout=sys.stderr,
                stdin=subprocess.DEVNULL,
            )


def missing(machine: Machine, wanted: dict[str, str] | None = None) -> list[str]:
    """Return the libraries that the machine lacks.

    wanted: the libraries to check, by default those that every run needs.
    """
    return [
        library
        for library in (LIBRARIES if wanted is None else wanted)
        if not machine.loads(library)
    ]


def refusal(machine: Machine | None = None) -> str:
    """Return one message with all missing libraries, their packages and the install command; "" if
    none."""
    machine = machine or Machine()
    lacking = missing(machine)
    if not lacking:
        return ""
    wanted = [LIBRARIES[library] for library in lacking]
    wanted += [FOR_PICTURES[library] for library in missing(machine, FOR_PICTURES)]
    return f"this machine lacks {_listed(lacking)}. {_remedy(wanted)}"


def check_machine(words: list[str] | None = None, machine: Machine | None = None) -> int:
    """Check the machine before the setup.

    Returns 0 if nothing is missing, else `EXIT_CODE` after printing the install command.
    """
    options = argparse.ArgumentParser(description="Check what this machine lacks.")
    options.add_argument(
        "--python", default=sys.executable, help="The Python 3.11 that will be used."
    )
    options.add_argument(
        "--install",
        action="store_true",
        help="As root on Debian or Ubuntu, install what is missing.",
    )
    asked = options.parse_args(words)
    machine = machine or Machine()
    if asked.install and machine.can_install():
        _install(machine, asked.python)
    wrong = machine.runs(asked.python)
    lacking = missing(machine)
    plain = missing(machine, FOR_PICTURES)
    if wrong or lacking:
        packages = [
            *(PYTHON if wrong else ()),
            *(LIBRARIES[x] for x in lacking),
            *(FOR_PICTURES[x] for x in plain),
        ]
        found = [
            *([f"Python 3.11 with venv ({wrong})"] if wrong else []),
            *([_listed(lacking)] if lacking else []),
        ]
        _say(f"error: this machine lacks {' and '.join(found)}. {_remedy(packages)}")
        if wrong:
            _say(
                "Where the system has no such Python, any other 3.11 will do: make "
                "PYTHON=/path/to/python3.11"
            )
        return EXIT_CODE
    if plain:
        _say(
            f"note: no {plain[0]} here, so pictures are PyBullet's plain ones. "
            f"{_remedy([*FOR_PICTURES.values()])}"
        )
    return 0


def _install(machine: Machine, python: str) -> None:
    """Install missing packages in two calls: a system may lack only the Python package."""
    here = {**LIBRARIES, **FOR_PICTURES}
    libraries = [here[library] for library in missing(machine, here)]
    for packages in ([*PYTHON] if machine.runs(python) else [], libraries):
        if packages:
            _say(
                f"This machine lacks {', '.join(packages)}: apt-get installs exactly that, "
                f"because you are root."
            )
            machine.install(packages)


def _listed(libraries: list[str]) -> str:
    return ", ".join(f"{library} (package {LIBRARIES[library]})" for library in libraries)


def _remedy(packages: list[str]) -> str:
    command = f"apt-get update && apt-get install -y --no-install-recommends {' '.join(packages)}"
    return f"On Debian and Ubuntu, as root: {command}"


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(check_machine())
