"""Faulty rows and URDFs of robots are refused before a run, with the file or the field."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import SpecError
from cosim.spec import robot as table
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER, DOG, ROBOTS, SCOUT, Legs, Robot, Skid
from physics.robots import urdf_path
from physics.robots.check import check_robot
from physics.robots.dog import DOG_MODEL
from physics.robots.kinematics import link_tree
from scenarios.runs.run import run
from tests.support.documents import blocks, text_of

WHEEL = "wheel_rear_left"
JOINT = re.compile(rf'  <joint name="{WHEEL}".*?</joint>\n', re.S)
LINK = re.compile(r'  <link name="rear_left">.*?</link>\n', re.S)


def edited(folder: Path, *changes: tuple[str | re.Pattern[str], str]) -> Robot:
    """Return the scout with an edited URDF."""
    text = urdf_path(SCOUT).read_text()
    for old, new in changes:
        after = text.replace(old, new) if isinstance(old, str) else old.sub(new, text)
        assert after != text
        text = after
    (folder / "mine.urdf").write_text(text)
    return dataclasses.replace(SCOUT, urdf=str(folder / "mine.urdf"))


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_shipped_robots_are_valid(robot: Robot) -> None:
    """The row and the URDF of each robot pass the check."""
    check_robot(robot)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ([(JOINT, "")], "no joint connects these links with 'base': rear_left"),
        ([(JOINT, ""), (LINK, "")], f"lacks joint '{WHEEL}' of the row .* Did you mean wheel_rear"),
        ([(LINK, "")], f"joint '{WHEEL}': its child link 'rear_left' does not exist"),
        ([('<mass value="0.7"/>', '<mass value="0"/>')], "mass of link 'front_left' must be posi"),
        ([('<mass value="0.7"/>', "")], "mass of link 'front_left' is missing"),
        ([('value="15.2"', 'value="heavy"')], "mass of link 'base': value must be a number, not"),
        ([('ixx="0.2255"', 'ixx="-1"')], "inertia of link 'base' must be positive about all axes"),
        ([('ixx="0.2255"', 'ixx="9"')], "inertia of link 'base' is that of no body"),
        ([('xyz="0.15 0.17 0.10"', 'xyz="150 170 100"')], "link 'front_left' is 247.8 m from the"),
        ([('<axis xyz="0 1 0"/>', '<axis xyz="0 -1 0"/>')], "axis of joint .* must be 0 1 0 .* -1"),
        ([('type="continuous"', 'type="fixed"')], "joint .* must be continuous, not fixed"),
        ([('xyz="0 0 0.14"', 'xyz="0 0 0.3"')], "centre of mass of 'base' is at .0 0 0.3. m; com"),
        ([('radius="0.10"', 'radius="0.2"')], "collision shape of wheel .* radius of 0.200 m"),
        ([('xyz="0.15 0.17 0.10"', 'xyz="0.15 -0.17 0.10"')], "of drive.left is at .0.15 -0.17"),
        ([('size="0.50 0.40 0.14"', 'size="0.50 0.60 0.14"')], "-0.300 to 0.300 m along y, and w"),
        ([('"base"', '"body"')], "its root link must be 'base', and is body"),
        ([('<box size="0.48 0.26 0.14"/>', '<capsule radius="1"/>')], "a visual is a capsule; val"),
        ([('rgba="0.16 0.18 0.20 1"', 'rgba="red"')], "rgba of a colour must be four numbers .* '"),
        ([('<box size="0.42 0.34 0.04"/>', '<mesh filename="a.obj"/>')], "mesh 'a.obj' does not"),
        ([("</robot>", "")], "is no XML: "),
        ([(re.compile(r"(?s).+"), "<sdf/>")], "its root element is <sdf>, not <robot>"),
    ],
    ids=lambda value: value[:24] if isinstance(value, str) else "",
)
def test_a_faulty_urdf_is_refused_with_its_path(
    changes: list[tuple[Any, str]], why: str, tmp_path: Path
) -> None:
    """Links, joints, masses, axes, units and sizes must match the row."""
    robot = edited(tmp_path, *changes)
    with pytest.raises(SpecError, match=why) as caught:
        check_robot(robot)
    assert str(caught.value).startswith(f"{robot.urdf}: ")


@pytest.mark.parametrize(
    ("robot", "changes", "why"),
    [
        (SCOUT, {"length_m": -0.5}, r"length_m must be in \(0, 3\], not -0.5"),
        (SCOUT, {"cruise_mps": 2.5}, "cruise_mps 2.5 is more than v_max_mps 2"),
        (SCOUT, {"acceleration_mps2": float("nan")}, "acceleration_mps2 must be in .* not nan"),
        (SCOUT, {"drive.torque_nm": 0.0}, r"drive.torque_nm must be in \(0, 10000\], not 0"),
        (SCOUT, {"drive.left": ("a",)}, "drive.left and drive.right must name as many joints"),
        (SCOUT, {"mounts": {"mast": SCOUT.mounts["mast"]}}, "mounts lacks 'front'"),
        (DOG, {"drive.kp": (1.0,)}, "drive.kp has 1 numbers for 12 joints"),
    ],
)
def test_a_faulty_row_is_refused_with_its_field(
    robot: Robot, changes: dict[str, Any], why: str
) -> None:
    """Numbers out of range, contradictions, and a missing mount are refused."""
    for name, value in changes.items():
        field = name.removeprefix("drive.")
        if field != name:
            value = dataclasses.replace(robot.drive, **{field: value})
        robot = dataclasses.replace(robot, **{name.partition(".")[0]: value})
    with pytest.raises(SpecError, match=f"^robot '{robot.name}': {why}"):
        check_robot(robot)


def test_the_robot_of_the_documents_is_valid(tmp_path: Path) -> None:
    """The row and the URDF on the page of robots agree."""
    (row,), (urdf,) = (blocks(language, "docs/robots.md") for language in ("python", "xml"))
    (tmp_path / "barrow.urdf").write_text(urdf.text)
    names: dict[str, Any] = {}
    exec(row.text, names)
    check_robot(dataclasses.replace(names["BARROW"], urdf=str(tmp_path / "barrow.urdf")))


def test_the_documents_have_the_fields_of_rows_and_the_joints_of_the_dog() -> None:
    """The page names every field of a row on wheels, and axis, range, rest angle and torque of each
    joint with their directions."""
    text = text_of("docs/robots.md")
    for field in (*dataclasses.fields(Robot), *dataclasses.fields(Skid)):
        assert field.name == "drive" or f"`{field.name}`" in text, field.name
    assert isinstance(DOG.drive, Legs)
    joints = {joint.name: joint for joint in DOG_MODEL.joints}
    rows = zip(DOG.drive.joints, DOG.drive.rest_rad, DOG.drive.torque_nm, strict=True)
    for name, rest_rad, torque_nm in rows:
        axis, (low, high) = joints[name].axis, joints[name].range_rad
        assert axis is not None
        cells = name, "xyz"[axis], f"{low:.4g} to {high:.4g}", f"{rest_rad:g}", f"{torque_nm:g}"
        assert "| `{}` | {} | {} | {} | {} |".format(*cells) in text
        leg = name.rpartition("_")[0]
        (x, y, _), (moved_x, moved_y, _) = (
            link_tree(urdf_path(DOG)).frames({name: angle})[f"{leg}_foot"][1] for angle in (0, 0.1)
        )
        assert moved_y > y if name.endswith("hip") else moved_x < x


def test_a_run_does_not_begin_with_a_faulty_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing URDF and an unknown joint are named, and no folder is made."""
    drive = dataclasses.replace(COURIER.drive, left=("wheel_front_left", "wheel_rear_lft"))
    for changes, why in (
        ({"urdf": str(tmp_path / "gone.urdf")}, r"gone.urdf: cannot be read: No such file"),
        ({"drive": drive}, r"courier.urdf: lacks joint 'wheel_rear_lft' .* wheel_rear_left\?"),
    ):
        row: Any = dataclasses.replace(COURIER, name="mine", **changes)  # type: ignore[arg-type]
        monkeypatch.setitem(table.ROBOTS, "mine", row)  # type: ignore[arg-type]
        with pytest.raises(SpecError, match=why):
            run("unit", episodes=1, out=tmp_path / "run", options=EpisodeOptions(robot="mine"))
    assert not (tmp_path / "run").exists()
