"""The packages themselves: names, layers, exports and documents."""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
import zipfile
from importlib.metadata import entry_points, packages_distributions
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.documents import PAGES

ROOT = Path(__file__).parents[1]
ROOMS = ("cosim", "sumo_nets", "physics", "bridge", "scenarios")


def test_no_other_distribution_owns_our_package_names() -> None:
    """The console script is the only one of this name."""
    owners = packages_distributions()
    for room in ROOMS:
        assert set(owners.get(room, ["sidewalk-cosim"])) == {"sidewalk-cosim"}
    assert [e.value for e in entry_points(group="console_scripts", name="cosim")] == [
        "cosim.__main__:main"
    ]


def test_cosim_imports_no_engine_and_no_other_package() -> None:
    """Everything in cosim/ can be imported without SUMO, PyBullet, Zenoh and the other packages,
    except bridge.policy_server. Modules that need PyTorch are left out if it is missing."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in sorted((ROOT / "cosim").rglob("*.py"))
        if path.name not in ("__init__.py", "__main__.py")
        and (path.parent.name != "learning" or find_spec("torch"))
    ]
    code = (
        f"import importlib, sys\nfor name in {modules!r}: importlib.import_module(name)\nrooms = "
        "{'libsumo', 'traci', 'pybullet', 'zenoh', 'sumo_nets', 'physics', 'bridge', "
        "'scenarios'}\nalone = {'bridge', 'bridge.policy_server'}\nprint(sorted({name for "
        "name in sys.modules if name.partition('.')[0] in rooms} - alone))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.engine
def test_the_wheel_holds_what_a_run_needs(tmp_path: Path) -> None:
    """The built wheel has every module, each package's type marker, the robots and the suites, and
    nothing else."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(tmp_path),
        str(ROOT),
    ]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("sidewalk_cosim-*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for room in ROOMS:
        assert f"{room}/py.typed" in names
        for path in (ROOT / room).rglob("*.py"):
            assert path.relative_to(ROOT).as_posix() in names
    needed = {
        "scenarios/suites/long-horizon.json",
        "physics/robots/courier.urdf",
        "scenarios/suites/user_scenarios/template.toml",
    }
    page = ("page.css", "page.html", "page.js", "tables.html", "viewer.html")
    assert {f"cosim/report/page/{name}" for name in page} <= names
    assert needed <= names
    assert not [n for n in names if n.split("/")[0] not in ROOMS and ".dist-info" not in n]


def test_the_documents_name_files_that_exist() -> None:
    """Every path and make target in the documents exists."""
    makefile = (ROOT / "Makefile").read_text()
    for name in (*PAGES, "ARCHITECTURE.md", "CONTRIBUTING.md"):
        text = (ROOT / name).read_text()
        for path in re.findall(
            r"`((?:cosim|sumo_nets|physics|bridge|scenarios|tests)/[\w./-]*)`", text
        ):
            if re.fullmatch(r"cosim/\w+-v\d", path):
                continue  # an id of an environment
            assert (ROOT / path).exists(), f"{name} names {path}"
        for target in re.findall(r"\bmake (\w+)", text):
            if target in ("run", "test", "check", "docs", "bench", "lock", "clean"):
                assert f"\n{target}:" in makefile


def test_modules_have_specific_names_and_at_most_700_lines() -> None:
    """No module is called utils, common, helpers, manager or misc."""
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            assert path.stem not in ("utils", "common", "helpers", "manager", "misc"), path
            assert len(path.read_text().splitlines()) <= 700, path


def test_architecture_shows_the_layers_that_are_enforced() -> None:
    """The list of layers is the contract of `.importlinter`, line by line."""
    contracts = configparser.ConfigParser()
    contracts.read(ROOT / ".importlinter")
    layers = contracts["importlinter:contract:layers"]["layers"].strip()
    assert layers.count("\n") == 11
    assert f"```\n{layers}\n```" in (ROOT / "ARCHITECTURE.md").read_text()


def test_each_engine_is_imported_where_architecture_says() -> None:
    """libsumo is imported in one file, zenoh in two, and PyBullet and OpenGL in one package, as the
    document states."""
    where: dict[str, set[str]] = {
        name: set() for name in ("libsumo", "zenoh", "pybullet", "moderngl")
    }
    for path in (path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))):
        text = path.read_text()
        if not any(name in text for name in where):
            continue
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in where.keys() & {name.partition(".")[0] for name in names}:
                where[name].add(path.relative_to(ROOT).as_posix())
    assert where["libsumo"] == {"sumo_nets/engine.py"}
    assert where["zenoh"] == {"bridge/policy_server.py", "bridge/session.py"}
    for name in ("pybullet", "moderngl"):
        assert where[name] and all(path.startswith("physics/") for path in where[name])
    text_of_architecture = " ".join((ROOT / "ARCHITECTURE.md").read_text().split())
    assert (
        "Only `sumo_nets/engine.py` imports libsumo, and only `physics` imports PyBullet and "
        "moderngl. Only `bridge/session.py` imports zenoh, and `bridge/policy_server.py`"
        in text_of_architecture
    )
