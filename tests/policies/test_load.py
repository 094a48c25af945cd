"""Policies by name: one that cannot be loaded is wrong use, reported with its name, whatever its
code does."""

from __future__ import annotations

import inspect
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cosim.core.errors import UsageError
from cosim.episode.policy_caller import PolicyCall
from cosim.policies import POLICIES
from cosim.policies.load import load_policy, source_hash
from cosim.policies.privileged.route import Route
from cosim.policies.user_module import importable_name

GOOD = """
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.core.state import STILL
from cosim.spec.robot import Mount
class Mine:
    manifest = Manifest("mine"{fields})
    def reset(self, scenario_id, seed): pass
    def act(self, observation): return STILL
"""
BAD = {
    "exits": ("import sys; sys.exit(0)", "cannot be imported: SystemExit: 0"),
    "interrupts": ("raise GeneratorExit", "cannot be imported: GeneratorExit"),
    "raises": (
        "import nowhere_to_be_found",
        "cannot be imported: ModuleNotFoundError: No module named",
    ),
    "broken": ("def", "cannot be imported: SyntaxError"),
    "exits-when-made": (
        "class Mine:\n def __init__(self): raise SystemExit(3)",
        "cannot be made: SystemExit: 3",
    ),
    "needs-more": ("class Mine:\n def __init__(self, x): pass", "cannot be made: TypeError"),
    "no-manifest": ("class Mine: pass", "has no attribute 'manifest'"),
    "odd-manifest": (
        "class Mine:\n @property\n def manifest(self): raise SystemExit(1)\n",
        "its manifest: SystemExit: 1",
    ),
    "no-act": (GOOD.replace("{fields}", "").replace("def act", "def drive"), "has no method 'act'"),
    "number-as-name": (
        GOOD.replace('"mine"{fields}', "3"),
        "its manifest: Expected `str`, got `int`",
    ),
    "path-as-name": (
        GOOD.replace('"mine"{fields}', '"../mine"'),
        "name must be a text of 1 to 100 printable",
    ),
    "no-name": (GOOD.replace('"mine"{fields}', '""'), "name must be a text of 1 to 100 printable"),
    "rate-as-text": (GOOD.replace("{fields}", ", rate_hz='4'"), "Expected `float`, got `str`"),
    "rate-zero": (GOOD.replace("{fields}", ", rate_hz=0"), "a policy rate must be positive"),
    "rate-nan": (
        GOOD.replace("{fields}", ", rate_hz=float('nan')"),
        "a policy rate must be positive",
    ),
    "rate-7": (GOOD.replace("{fields}", ", rate_hz=7"), "usual policy rates are 4, 5, 10, 20 Hz"),
    "waypoints-now": (
        GOOD.replace("{fields}", ", waypoints=WaypointRule(dt_s=0.0)"),
        "waypoints dt_s must be a positive number, not 0.0",
    ),
    "waypoint-from-the-end": (
        GOOD.replace("{fields}", ", waypoints=WaypointRule(index=-1)"),
        "waypoints index must be a whole number from 0, not -1",
    ),
    "waypoints-by-magic": (
        GOOD.replace("{fields}", ", waypoints=WaypointRule(rule='magic')"),
        "waypoints rule must be one of shipped, atan2, not 'magic'",
    ),
    "waypoints-as-number": (
        GOOD.replace("{fields}", ", waypoints=2"),
        "its manifest: Expected `object`, got `int`",
    ),
    "no-pixels": (
        GOOD.replace("{fields}", ", camera=CameraSpec(0, 96)"),
        "sides of 1 to 4096 pixels, not 0 x 96",
    ),
    "fish-eye": (
        GOOD.replace("{fields}", ", camera=CameraSpec(fov_deg=190)"),
        "fov_deg must be between 0 and 180",
    ),
    "crop-beyond": (
        GOOD.replace("{fields}", ", camera=CameraSpec(96, 96, crop=(0, 0, 97, 96))"),
        "camera crop must be (x0, y0, x1, y1) within 96 x 96 pixels, x0 < x1 and y0 < y1, "
        "not (0, 0, 97, 96)",
    ),
    "no-such-goal": (
        GOOD.replace("{fields}", ", goal='route'"),
        "unknown goal protocol 'route'. Valid choices: final_p",
    ),
    "no-such-odometry": (
        GOOD.replace("{fields}", ", odometry='imu'"),
        "unknown odometry 'imu'. Valid choices: exact, gps",
    ),
    "image-for-the-blind": (
        GOOD.replace("{fields}", ", camera=None, goal='image'"),
        "has no camera, and goal protocol",
    ),
    "no-pixels-left": (
        GOOD.replace("{fields}", ", cameras={'left': CameraSpec(0, 96)}"),
        "sides of 1 to 4096 pixels, not 0 x 96",
    ),
    "lost-mount": (
        GOOD.replace("{fields}", ", camera=CameraSpec(mount=Mount((0.0, float('inf'), 0.0)))"),
        "mount at_m, pitch_down_deg and yaw_left_deg must be finite",
    ),
}


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for the module of a policy."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    for name in [*sys.modules]:
        source = getattr(sys.modules[name], "__file__", None)
        if source and Path(source).is_relative_to(tmp_path):
            del sys.modules[name]


@pytest.mark.parametrize("name", BAD)
def test_a_policy_that_cannot_be_loaded_is_named_with_the_reason(
    workspace: Path, name: str
) -> None:
    """The reason covers faults of module, class and manifest, SystemExit included."""
    source, expected = BAD[name]
    (workspace / "mine.py").write_text(source)
    with pytest.raises(UsageError) as caught:
        load_policy("mine:Mine")
    assert "'mine:Mine'" in str(caught.value) and expected in str(caught.value)


@pytest.mark.parametrize(
    ("name", "meant"), [("ros2", "ros2:"), ("zenoh", "zenoh:NAME")], ids=["ros2", "zenoh"]
)
def test_an_unknown_policy_is_answered_with_the_valid_choices(name: str, meant: str) -> None:
    """A name without its colon gets the intended one, and all choices are listed."""
    with pytest.raises(UsageError, match=rf"Valid choices: cadrl, .* Did you mean {meant}\?"):
        load_policy(name)


def test_loading_keeps_the_working_folder(workspace: Path) -> None:
    """A module that changes the working folder changes no relative path of the run."""
    (workspace / "mine.py").write_text("import os; os.chdir('/')" + GOOD.format(fields=""))
    assert load_policy("mine:Mine").manifest.name == "mine"
    assert Path.cwd() == workspace


def test_loading_is_timed(workspace: Path) -> None:
    """The timer starts and stops around loading."""
    calls: list[PolicyCall | None] = []

    class Notes:
        def starts(self, doing: PolicyCall, tick: int) -> None:
            calls.append(doing)

        def stops(self) -> None:
            calls.append(None)

    (workspace / "mine.py").write_text(GOOD.format(fields=""))
    load_policy("mine:Mine", Notes()).reset("a", 0)
    assert calls == ["loading", None, "reset", None]


def test_an_edited_policy_has_another_hash(workspace: Path) -> None:
    """The hash follows the text of its file, wherever that lies, and that of a base class in
    another file."""

    def hash_of(text: str, base: str = "class Base: pass") -> str:
        (workspace / "mine.py").write_text(text)
        (workspace / "base.py").write_text(base)
        for name in ("mine", "base"):
            sys.modules.pop(name, None)
        return load_policy("mine:Mine").source_hash

    plain = GOOD.format(fields="")
    child = plain.replace("class Mine", "from base import Base\nclass Mine(Base)")
    first = hash_of(plain)
    assert len(first) == 16 and hash_of(plain) == first
    assert hash_of(plain + "# a word") != first
    assert hash_of(child) != hash_of(child, "class Base: kept = 1")
    (workspace / "further").mkdir()
    os.chdir(workspace / "further")
    assert load_policy("mine:Mine").source_hash == hash_of(child, "class Base: kept = 1")


def write_policies(workspace: Path) -> None:
    """Write a policy in this folder, one next to its import in another, and one in a package that
    imports its own modules."""
    (workspace / "mine.py").write_text(GOOD.format(fields=""))
    (workspace / "deeper").mkdir()
    (workspace / "deeper/alone.py").write_text("import sibling" + GOOD.format(fields=""))
    (workspace / "deeper/sibling.py").touch()
    (workspace / "whole/inner").mkdir(parents=True)
    for part in ("whole/__init__.py", "whole/inner/__init__.py", "whole/part.py"):
        (workspace / part).touch()
    (workspace / "whole/inner/driving.py").write_text(
        "from ..part import __name__ as part" + GOOD.format(fields="")
    )


@pytest.mark.parametrize(
    ("spelled", "imported"),
    [
        ("mine.py:Mine", "mine:Mine"),
        ("./mine.py:Mine", "mine:Mine"),
        ("{workspace}/mine.py:Mine", "mine:Mine"),
        ("deeper/../mine.py:Mine", "mine:Mine"),
        ("deeper/alone.py:Mine", "alone:Mine"),
        ("{workspace}/deeper/alone.py:Mine", "alone:Mine"),
        ("whole/inner/driving.py:Mine", "whole.inner.driving:Mine"),
    ],
)
def test_a_policy_is_named_by_its_file_or_its_module(
    workspace: Path, spelled: str, imported: str
) -> None:
    """Both spellings load the same class and source hash, and sibling and relative imports work."""
    write_policies(workspace)
    spelled = spelled.format(workspace=workspace)
    assert importable_name(spelled) == imported and importable_name(imported) == imported
    by_file, by_module = load_policy(spelled), load_policy(imported)
    assert (
        type(by_file.policy) is type(by_module.policy)
        and by_file.source_hash == by_module.source_hash != ""
    )


def test_a_name_that_is_no_file_is_unchanged() -> None:
    """Shipped policies, networks, served policies and modules are no files."""
    for name in (
        "orca",
        "onnx:my_network",
        "onnx:a/b.onnx",
        "zenoh:mine",
        "my_robot.policy:Mine",
        "",
    ):
        assert importable_name(name) == name


MISNAMED = {
    "no such file": (
        "min.py:Mine",
        "there is no file {workspace}/min.py. Python files in {workspace}: mine.py. Did you mean",
    ),
    "a file elsewhere": (
        "alone.py:Mine",
        "Python files in {workspace}: mine.py. Did you mean deeper/alone.py?",
    ),
    "no such folder": (
        "lost/mine.py:Mine",
        "there is no file {workspace}/lost/mine.py. Python files in {workspace}/lost: none.",
    ),
    "no class": ("mine.py", "names a file and no class: write mine.py:Mine. Classes in it: Mine"),
    "another class": (
        "mine.py:Yours",
        "unknown class in module 'mine' 'Yours'. Valid choices: Mine.",
    ),
    "a module of Python": (
        "random.py:Mine",
        "there is another module 'random', which comes with Python: rename",
    ),
    "a dot in its name": (
        "mine.v2.py:Mine",
        "'mine.v2' has a dot, and a module's name has none: rename it",
    ),
    "two of one name": (
        "deeper/mine.py:Mine",
        "there is another module 'mine', loaded from {workspace}/mine.py: rename",
    ),
}


@pytest.mark.parametrize("name", MISNAMED)
def test_a_file_that_cannot_be_loaded_is_named_with_the_remedy(workspace: Path, name: str) -> None:
    """The message has the file, its valid choices, and what to do instead."""
    write_policies(workspace)
    load_policy("mine:Mine")
    spelled, expected = MISNAMED[name]
    if not name.startswith("no ") and "elsewhere" not in name:
        (workspace / spelled.partition(":")[0]).write_text(GOOD.format(fields=""))
    with pytest.raises(UsageError) as caught:
        load_policy(spelled)
    assert expected.format(workspace=workspace) in str(caught.value)


def test_a_missing_module_is_reported_with_the_search_path(
    workspace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All folders of the path but Python's own are listed, with a file of that name in a subfolder."""
    monkeypatch.syspath_prepend(workspace / "libraries")
    write_policies(workspace)
    with pytest.raises(UsageError) as caught:
        load_policy("alone:Mine")
    message = str(caught.value)
    assert (
        f"{workspace / 'libraries'}, {workspace}" in message.partition("Searched: ")[2]
        and "lib-dynload" not in message
    )
    assert message.endswith(
        "Run the command in the folder that holds alone.py, add that folder to PYTHONPATH, or "
        "name the file: deeper/alone.py:Mine"
    )
    (workspace / "lost").mkdir()
    with pytest.raises(
        UsageError, match=r"'lost' is a folder without code here. Searched: .*path/to/lost.py:Mine$"
    ):
        load_policy("lost:Mine")
    (workspace / "mine.py").write_text("import not_installed")
    with pytest.raises(UsageError) as caught:
        load_policy("mine.py:Mine")
    assert f"Searched: {workspace}" in str(caught.value)
    assert f"Install 'not_installed' for {sys.executable}, or add its folder to PYTHONPATH" in str(
        caught.value
    )


@pytest.mark.parametrize("name", ["stop", "straight"])
def test_the_simplest_baselines_are_blind(name: str) -> None:
    """`stop` and `straight` have no sensor, so their runs draw no pictures."""
    assert load_policy(name).manifest.track == "blind"


def test_shipped_policies_of_different_files_have_different_hashes() -> None:
    """Two shipped policies have the same hash only if their classes are in the same file."""
    loaded = [load_policy(name) for name in POLICIES]
    files = {(one.source_hash, inspect.getfile(type(one.policy))) for one in loaded}
    hashes, sources = zip(*files, strict=True)
    assert all(hashes) and len({*hashes}) == len({*sources}) == len(files) > 2, files


def test_the_hash_of_a_shipped_policy_covers_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An edit of any module in the folder of its class changes the hash."""
    route = Route()
    copied = shutil.copytree(Path(inspect.getfile(type(route))).parent, tmp_path / "privileged")
    monkeypatch.setattr(inspect, "getfile", lambda _: str(copied / "route.py"))
    before = source_hash(route)
    planner = copied / "route_planner.py"
    planner.write_text(planner.read_text() + "# edited")
    assert source_hash(route) != before
