"""What an isolated policy may read: Python and its packages, the system's libraries, the policy's
own folder, and what `--policy-data` names."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from cosim.core.errors import UsageError
from cosim.policies.load import ONNX_SCHEME, WEIGHTED_POLICIES, shipped_bundles
from cosim.policies.onnx.graph import PROVIDERS_VARIABLE
from cosim.policies.onnx.weights import WEIGHTS_VARIABLE, weight_folders
from cosim.spec.options import PolicyHost
from scenarios.ipc.sandbox import Sandbox

_OF_SYSTEM: Final = (
    *("/usr", "/lib", "/lib32", "/lib64", "/bin", "/sbin", "/nix/store"),
    *("/etc/ld.so.cache", "/etc/ld.so.conf", "/etc/ld.so.conf.d", "/etc/alternatives"),
    *("/etc/localtime", "/etc/fonts"),
)
"""Libraries and programs of the system, and what they read."""
_PACKAGE_FOLDERS: Final = ("site-packages", "dist-packages")
_OWN: Final = ("cosim", "bridge", "scenarios", "physics", "sumo_nets")
"""Packages of this project."""
_SUITES: Final = str(Path(__file__).resolve().parents[1] / "suites")
"""Folder of the suites, which a policy may not read."""
_PASSED: Final = (
    *("LANG", "LANGUAGE", "TZ", "PATH", "LD_LIBRARY_PATH", "PYTHONHASHSEED", "GLIBC_TUNABLES"),
    PROVIDERS_VARIABLE,
)
_PASSED_BEGINNINGS: Final = (
    *("LC_", "OMP_", "MKL_", "OPENBLAS_", "NPY_", "GOTO_", "BLIS_", "KMP_"),
    *("CUDA_", "CUBLAS_", "CUDNN_", "NVIDIA_"),
)
"""Environment variables that a policy gets, by name and by the beginning of the name: language,
paths of libraries, and what determines arithmetic."""
_GB: Final = 10**9


def sandbox_for(name: str, kind: str, host: PolicyHost) -> Sandbox:
    """Return the sandbox of a policy.

    kind: of `scenarios.ipc.sandbox.KINDS`.
    Raises UsageError if the policy's own folder is one that an isolated policy may not read.
    """
    hidden = (_SUITES, *(os.path.realpath(path) for path in host.hidden))
    around = tuple(str(Path(path).parent) for path in hidden[1:])
    reads = [(path, hidden) for path in (*_of_python(), *_OF_SYSTEM, *host.data)]
    for folder in _own_folders(name):
        real = os.path.realpath(folder)
        # Other runs in the same folder are hidden too, unless the policy itself is there.
        others = [path for path in around if not Path(real).is_relative_to(path)]
        reads.append((str(folder), (*hidden, *others)))
    imports = dict.fromkeys(str(Path(entry).absolute()) for entry in ("", *sys.path))
    memory_bytes = int(_GB * host.memory_gb)
    return Sandbox(kind, tuple(reads), tuple(imports), tuple(_environment()), memory_bytes)


def name_in_sandbox(name: str) -> str:
    """Return a policy's name as it loads from any working folder.

    >>> name_in_sandbox("onnx:/net")
    'onnx:/net'
    """
    if not name.startswith(ONNX_SCHEME):
        return name
    return f"{ONNX_SCHEME}{Path(name.removeprefix(ONNX_SCHEME)).expanduser().absolute()}"


def _environment() -> Iterator[tuple[str, str]]:
    """Yield the environment variables that a policy gets."""
    for name, value in os.environ.items():
        if name in _PASSED or name.startswith(_PASSED_BEGINNINGS):
            yield name, value
    *named, users = weight_folders()
    yield "XDG_DATA_HOME", str(users.parents[1].absolute())
    yield from ((WEIGHTS_VARIABLE, str(folder.absolute())) for folder in named)


def _of_python() -> list[str]:
    """Return the folders of Python and of all installed packages, and this project's packages."""
    found = [sys.prefix, sys.base_prefix, sys.exec_prefix, sys.executable]
    found += [entry for entry in sys.path if Path(entry).name in _PACKAGE_FOLDERS]
    specs = map(find_spec, _OWN)  # found without being imported
    return [*found, *(folder for one in specs for folder in _folders(one))]


def _own_folders(name: str) -> list[Path]:
    """Return a policy's own folder, or the folders of its package, and those of its weights.

    Raises UsageError.
    """
    if name.startswith(ONNX_SCHEME):
        return [
            _checked_folder(name, Path(name_in_sandbox(name).removeprefix(ONNX_SCHEME))),
            *weight_folders(),
        ]
    if ":" not in name:
        return weight_folders() if name in {*WEIGHTED_POLICIES, *shipped_bundles()} else []
    top = name.partition(":")[0].partition(".")[0]
    found = PathFinder.find_spec(top, ["", *sys.path])
    folders = _folders(found)
    if not folders and found is not None and found.origin is not None:
        folders = [str(Path(found.origin).parent)]
    return [_checked_folder(name, Path(folder)) for folder in folders]


def _folders(spec: ModuleSpec | None) -> list[str]:
    """Return the folders of a package; none of a module, or of what is missing."""
    return [] if spec is None else list(spec.submodule_search_locations or ())


def _checked_folder(name: str, folder: Path) -> Path:
    """Return a policy's folder. Raises UsageError if it holds what is none of a policy's."""
    real = folder.resolve()
    shared = [Path(tempfile.gettempdir()), Path("/tmp"), Path("/var/tmp"), Path("/dev/shm")]
    for one in (Path.home(), *shared):
        if one.resolve().is_relative_to(real):
            raise UsageError(
                f"policy '{name}' is in {folder}, which --isolated does not show to a policy: put "
                "it in a folder of its own, with the files that it reads"
            )
    return folder
