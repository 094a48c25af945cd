"""Find and import a user's policy class: `package.module:Class` or `path/to/file.py:Class`."""

from __future__ import annotations

import ast
import importlib
import os
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from cosim.core.errors import UsageError, nearest, unknown

_SUFFIX = ".py"


class _File(NamedTuple):
    """Source file of a policy.

    root: Folder to import from.
    module: Dotted module name below root.
    """

    path: Path
    root: Path
    module: str


def importable_name(name: str) -> str:
    """Return a policy's name as `package.module:Class`, importable in every process of a run.

    For `path/to/file.py:Class`, the import root is put first on `sys.path`, which child processes
    inherit. A file in a package is imported as part of it. Other names are returned unchanged.
    Raises UsageError if the file is missing, no class is named, or another module has its name.
    """
    path, class_name = _split(name)
    if not path.endswith(_SUFFIX):
        return name
    file = _located(name, Path(path).expanduser())
    if not class_name:
        classes = _classes_written(file.path)
        raise UsageError(
            f"policy '{name}' names a file and no class: write {name}:{(*classes, 'CLASS')[0]}. "
            f"Classes in it: {', '.join(classes) or 'none'}"
        )
    add_to_path(Path.cwd())
    add_to_path(file.root, first=True)
    return f"{file.module}:{class_name}"


def policy_module(name: str) -> tuple[ModuleType, str]:
    """Import the module of a policy's name; return it and the class name.

    Raises any exception of the module.
    """
    module_name, class_name = _split(name)
    add_to_path(Path.cwd())
    return importlib.import_module(module_name), class_name


def policy_class(module: ModuleType, class_name: str) -> Callable[[], object]:
    """Return a class of a module. Raises UsageError with the valid choices."""
    if not hasattr(module, class_name):
        there = {
            k: v
            for k, v in vars(module).items()
            if isinstance(v, type) and v.__module__ == module.__name__
        }
        policies = [k for k, v in there.items() if callable(getattr(v, "act", None))]
        raise unknown(f"class in module '{module.__name__}'", class_name, policies or there)
    found: Callable[[], object] = getattr(module, class_name)
    return found


def add_to_path(folder: Path, *, first: bool = False) -> None:
    """Add a folder to the front of `sys.path`.

    first: Move it to the front if it is already on the path.
    """
    entry = str(folder)
    if first and entry in sys.path[1:]:
        sys.path.remove(entry)
    if entry not in sys.path:
        sys.path.insert(0, entry)


def _classes_written(file: Path) -> list[str]:
    """Return the top-level classes with a method `act`, without running the file."""
    try:
        top = ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return []
    found = [node for node in top if isinstance(node, ast.ClassDef)]
    return [
        one.name for one in found if any(getattr(part, "name", "") == "act" for part in one.body)
    ]


def _split(name: str) -> tuple[str, str]:
    """Split a name into module or file, and class."""
    before, colon, after = name.rpartition(":")
    return (before, after) if colon else (name, "")


def _located(name: str, path: Path) -> _File:
    """Find a file and its import root. Raises UsageError if it is missing or cannot be imported."""
    if not path.is_file():
        here = (
            sorted(file.name for file in path.parent.glob(f"*{_SUFFIX}"))
            if path.parent.is_dir()
            else []
        )
        meant = (
            f" Did you mean {found[0]}?"
            if (found := _files_below(path.name))
            else nearest(path.name, here)
        )
        there = f"Python files in {path.parent.absolute()}: {', '.join(here) or 'none'}.{meant}"
        raise UsageError(f"policy '{name}': there is no file {path.absolute()}. {there}")
    file = Path(os.path.abspath(path))  # noqa: PTH100  a link keeps its name
    root = file.parent
    parts = [] if file.stem == "__init__" else [file.stem]
    while (root / "__init__.py").is_file():
        root, parts = root.parent, [root.name, *parts]
    if bad := next((part for part in parts if "." in part), ""):
        raise UsageError(
            f"policy '{name}': '{bad}' has a dot, and a module's name has none: rename it"
        )
    top = parts[0]
    ours = file if (root / top).with_suffix(_SUFFIX) == file else root / top
    if other := _other_module(top, ours):
        raise UsageError(
            f"policy '{name}': there is another module '{top}', {other}: rename {ours}"
        )
    return _File(file, root, ".".join(parts))


def _other_module(top: str, ours: Path) -> str:
    """Describe another module with the same name; "" if there is none."""
    if top in sys.stdlib_module_names:
        return "which comes with Python"
    loaded = getattr(sys.modules.get(top), "__file__", None)
    if loaded is None or Path(loaded).resolve() in (ours.resolve(), ours.resolve() / "__init__.py"):
        return ""
    return f"loaded from {loaded}"


def remedy_for_missing(name: str, missing: str) -> str:
    """Describe the folders searched for a missing module, and a remedy.

    missing: Name of the module, the policy's own or one that it imports.
    """
    module_name, class_name = _split(name)
    own = {sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib")}
    own |= {str(Path(folder, "lib-dynload")) for folder in own} | {
        folder for folder in sys.path if ".zip" in folder
    }
    folders = dict.fromkeys(str(Path(entry).absolute()) for entry in sys.path if entry not in own)
    searched = f"Searched: {', '.join(folders)}."
    if missing != module_name and not module_name.startswith(f"{missing}."):
        return (
            f"{searched} Install '{missing}' for {sys.executable}, or add its folder to PYTHONPATH"
        )
    tail = f"{module_name.replace('.', '/')}{_SUFFIX}"
    given = next(iter(_files_below(Path(tail).name)), Path("path/to", Path(tail).name))
    return (
        f"{searched} Run the command in the folder that holds {tail}, add that folder to "
        f"PYTHONPATH, or name the file: {given}:{class_name}"
    )


def _files_below(name: str) -> list[Path]:
    """Return relative paths of files with this name, at most two folders below the current one."""
    here = Path.cwd()
    return [
        file.relative_to(here)
        for below in ("", "*/", "*/*/")
        for file in sorted(here.glob(f"{below}{name}"))
    ]
