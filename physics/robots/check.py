"""Check of a robot before it is used: the fields of its row, its URDF, and that both agree."""

from __future__ import annotations

import math
import xml.etree.ElementTree as xml
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from cosim.core.errors import SpecError, nearest
from cosim.core.geometry import Floats
from cosim.spec.robot import Legs, Mount, Robot, Skid
from cosim.spec.spec_file import join_faults
from cosim.spec.validation import Within
from physics.robots import robot_hash, urdf_path
from physics.robots.kinematics import LinkTree, origin_of, rotate, tree_of
from physics.robots.shapes import shape_of

_BASE: Final = "base"
"""Name of a URDF's root link."""
_FARTHEST_M: Final = 3.0
"""Largest distance of a link from the base link; URDFs in millimetres exceed it."""
_OUTLINE_M: Final = 0.02
"""Largest difference between the collision shapes and the box of the row, metres."""
_PLACE_M: Final = 0.01
"""Largest difference of wheels and of the centre of mass from the row, metres."""
_MESHES: Final = (".obj", ".stl", ".dae")
"""Mesh files that PyBullet reads as collision shapes."""
_LENGTH_M: Final = Within(0, _FARTHEST_M, above=True)
_SPEED: Final = Within(0, 20, above=True)
_RAMP: Final = Within(0, 100, above=True)
_TORQUE_NM: Final = Within(0, 10_000, above=True)
_GAIN: Final = Within(0, 10_000)
_checked: Final[set[str]] = set()
"""Hashes of the robots that this process has found valid."""


def check_robot(robot: Robot) -> None:
    """Check a robot's row and URDF. Raises SpecError with the row's or the file's faults."""
    digest = robot_hash(robot)
    if digest in _checked:
        return
    if faults := list(_row_faults(robot)):
        raise SpecError(f"robot '{robot.name}': {join_faults(faults)}")
    path = urdf_path(robot)
    try:
        root = xml.fromstring(path.read_bytes())
        faults = list(_structure_faults(root)) or list(_body_faults(robot, root, path))
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}") from error
    except xml.ParseError as error:
        raise SpecError(f"{path}: is no XML: {error}") from error
    except ValueError as error:
        words = str(error)
        raise SpecError(words if words.startswith(f"{path}: ") else f"{path}: {words}") from error
    if faults:
        raise SpecError(f"{path}: {join_faults(faults)}")
    _checked.add(digest)


def _row_faults(robot: Robot) -> Iterator[str]:
    """Yield the fields of a row that are out of range or contradict each other."""
    drive = robot.drive
    values: list[tuple[str, float, Within]] = [
        *((name, getattr(robot, name), _LENGTH_M) for name in ("length_m", "width_m", "height_m")),
        ("com_height_m", robot.com_height_m, _LENGTH_M),
        *((name, getattr(robot, name), _SPEED) for name in ("cruise_mps", "v_max_mps")),
        ("w_max_radps", robot.w_max_radps, _SPEED),
        ("acceleration_mps2", robot.acceleration_mps2, _RAMP),
        ("acceleration_radps2", robot.acceleration_radps2, _RAMP),
        *((f"drive.span_m[{k}]", side, _LENGTH_M) for k, side in enumerate(drive.span_m)),
        *((f"drive.stride_m[{k}]", side, _LENGTH_M) for k, side in enumerate(drive.stride_m)),
    ]
    if isinstance(drive, Skid):
        values.append(("drive.wheel_radius_m", drive.wheel_radius_m, _LENGTH_M))
        values.append(("drive.torque_nm", drive.torque_nm, _TORQUE_NM))
        if not drive.left or len(drive.left) != len(drive.right):
            yield "drive.left and drive.right must name as many joints each, at least one"
    else:
        values += [("drive.stand_m", drive.stand_m, _LENGTH_M)]
        values += [("drive.cycle_s", drive.cycle_s, Within(0.05, 10))]
        for name, rule in (("torque_nm", _TORQUE_NM), ("kp", _GAIN), ("kd", _GAIN)):
            given: Sequence[float] = getattr(drive, name)
            values += [(f"drive.{name}[{k}]", one, rule) for k, one in enumerate(given)]
        for name in ("rest_rad", "kp", "kd", "torque_nm"):
            if (count := len(getattr(drive, name))) != len(drive.joints):
                yield f"drive.{name} has {count} numbers for {len(drive.joints)} joints"
    yield from filter(None, (rule.refusal(name, value) for name, value, rule in values))
    if robot.cruise_mps > robot.v_max_mps:
        yield f"cruise_mps {robot.cruise_mps:g} is more than v_max_mps {robot.v_max_mps:g}"
    if len({*drive.joints}) < len(drive.joints):
        yield f"drive names a joint twice: {', '.join(drive.joints)}"
    if "front" not in robot.mounts:
        yield f"mounts lacks 'front', the default of policies; it has {', '.join(robot.mounts)}"
    for name, mount in robot.mounts.items():
        yield from (f"mounts['{name}'] {fault}" for fault in _mount_faults(mount))


def _mount_faults(mount: Mount) -> Iterator[str]:
    if not all(abs(value) <= _FARTHEST_M for value in mount.at_m):
        yield f"at_m must be within {_FARTHEST_M:g} m of the base, not {mount.at_m}"
    low, high = mount.fov_deg
    if not 0.0 < low <= high < 180.0:
        yield f"fov_deg must be two angles between 0 and 180, not {mount.fov_deg}"
    if not (min(mount.most_px) > 0 and mount.most_hz > 0.0):
        yield "most_px and most_hz must be positive"


def _structure_faults(root: xml.Element) -> Iterator[str]:
    """Yield why the links and joints of a URDF are no tree below the base link."""
    if root.tag != "robot":
        yield f"its root element is <{root.tag}>, not <robot>"
        return
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        yield from (f"{kind} '{n}' exists twice" for n in sorted({*names}) if names.count(n) > 1)
    links = [link.get("name", "") for link in root.findall("link")]
    children = []
    for joint in root.findall("joint"):
        for end in ("parent", "child"):
            element = joint.find(end)
            link = "" if element is None else element.get("link", "")
            if link not in links:
                yield f"joint '{joint.get('name', '')}': its {end} link '{link}' does not exist"
            if end == "child":
                children.append(link)
    yield from (f"link '{n}' has two joints" for n in sorted({*children}) if children.count(n) > 1)
    roots = [link for link in links if link not in children]
    if roots[:1] != [_BASE] and _BASE not in roots:
        yield f"its root link must be '{_BASE}', and is {', '.join(roots) or 'missing'}"
    elif len(roots) > 1:
        others = ", ".join(name for name in roots if name != _BASE)
        yield f"no joint connects these links with '{_BASE}': {others}"
    elif len(tree_of(root).joints) < len(children):
        yield f"its joints form a ring that is not connected with '{_BASE}'"


def _body_faults(robot: Robot, root: xml.Element, path: Path) -> Iterator[str]:
    """Yield what is wrong with masses and joints, and what differs from the row."""
    for link in root.findall("link"):
        yield from _inertial_faults(link)
    yield from _visual_faults(root, path)
    drive, tree = robot.drive, tree_of(root)
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in root.findall("joint")}
    if lacking := [name for name in drive.joints if name not in kinds]:
        yield from (
            f"lacks joint '{name}' of the row of robot '{robot.name}'; its joints are "
            f"{', '.join(kinds)}.{nearest(name, kinds)}"
            for name in lacking
        )
        return
    rest = dict(zip(drive.joints, drive.rest_rad, strict=True)) if isinstance(drive, Legs) else {}
    for name, (_, at) in tree.frames(rest).items():
        if not math.hypot(*at) <= _FARTHEST_M:
            yield (
                f"link '{name}' is {math.hypot(*at):.4g} m from the base link, and at most "
                f"{_FARTHEST_M:g} m are valid: lengths are in metres"
            )
            return
    corners = _collision_corners(root, tree, rest, path)
    valid = ("revolute", "continuous") if isinstance(drive, Legs) else ("continuous",)
    if isinstance(drive, Legs):
        links = {*tree.frames({})}
        yield from (
            f"lacks link '{name}' of feet or trunk of robot '{robot.name}'"
            for name in (*drive.feet, *drive.trunk)
            if name not in links
        )
    else:
        yield from _wheel_faults(drive, tree, corners)
        yield from _base_faults(robot, root)
    yield from (
        f"joint '{name}' must be {' or '.join(valid)}, not {kinds[name] or 'without a type'}"
        for name in drive.joints
        if kinds[name] not in valid
    )
    yield from _outline_faults(robot, corners)


def _inertial_faults(link: xml.Element) -> Iterator[str]:
    name, inertial = link.get("name", ""), link.find("inertial")
    if inertial is None:
        yield f"link '{name}' lacks <inertial>: PyBullet would give it 1 kg"
        return
    mass = _numbers(inertial.find("mass"), f"mass of link '{name}'", "value")[0]
    if not 0.0 < mass < math.inf:
        yield f"mass of link '{name}' must be positive, not {mass:g} kg"
    words = f"inertia of link '{name}'"
    xx, yy, zz, xy, xz, yz = _numbers(
        inertial.find("inertia"), words, "ixx", "iyy", "izz", "ixy", "ixz", "iyz"
    )
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    values = np.linalg.eigvalsh(tensor).tolist() if np.isfinite(tensor).all() else [math.nan] * 3
    if not values[0] > 0.0:
        yield f"{words} must be positive about all axes, not ixx {xx:g}, iyy {yy:g}, izz {zz:g}"
    elif not values[2] <= 1.000001 * (values[0] + values[1]):
        yield (
            f"{words} is that of no body: about one axis it is larger than the sum of the others "
            f"({', '.join(f'{one:.4g}' for one in values)} kg m2)"
        )


def _visual_faults(root: xml.Element, path: Path) -> Iterator[str]:
    """Yield visuals that cannot be drawn. Raises SpecError for an unknown shape."""
    for visual in root.iter("visual"):
        mesh = visual.find("geometry/mesh")
        if mesh is None:
            shape_of(visual, path)
        elif not (path.parent / (name := mesh.get("filename", ""))).is_file():
            yield f"visual mesh '{name}' does not exist beside it"
    for colour in root.iter("color"):
        rgba = colour.get("rgba", "")
        if not _is_rgba(rgba):
            yield f"rgba of a colour must be four numbers from 0 to 1, not '{rgba}'"


def _is_rgba(text: str) -> bool:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return False
    return len(values) == 4 and all(0.0 <= value <= 1.0 for value in values)


def _base_faults(robot: Robot, root: xml.Element) -> Iterator[str]:
    """Yield how centre of mass and axes of the base link differ from those of a robot on wheels."""
    inertial = next(x for x in root.findall("link") if x.get("name") == _BASE).find("inertial")
    if inertial is None or (inertia := inertial.find("inertia")) is None:
        return
    turn, at = origin_of(inertial)
    if not math.dist(at, (0.0, 0.0, robot.com_height_m)) <= _PLACE_M:
        yield (
            f"the centre of mass of '{_BASE}' is at ({_spaced(at)}) m; com_height_m "
            f"{robot.com_height_m:g} of the row needs (0 0 {robot.com_height_m:g})"
        )
    mixed = any(float(inertia.get(name, "0")) for name in ("ixy", "ixz", "iyz"))
    if mixed or not np.allclose(turn, np.eye(3), atol=1e-6):
        yield f"the principal axes of '{_BASE}' must be those of its frame: no rpy, ixy, ixz, iyz"


def _wheel_faults(drive: Skid, tree: LinkTree, corners: dict[str, Floats]) -> Iterator[str]:
    """Yield how axes, places and radii of wheels differ from the row."""
    frames, half = tree.frames({}), 0.5 * drive.span_m[1]
    joints = {joint.name: joint for joint in tree.joints}
    for side, aside_m, names in (("left", half, drive.left), ("right", -half, drive.right)):
        found = []
        for name in names:
            joint = joints[name]
            turn, (x, y, z) = frames[joint.child]
            if not math.dist(axis := rotate(turn, joint.axis), (0.0, 1.0, 0.0)) < 1e-6:
                yield (
                    f"axis of joint '{name}' must be 0 1 0 in the base link's frame, so that "
                    f"positive speeds drive ahead, not {_spaced(axis)}"
                )
            found.append(x)
            if abs(y - aside_m) > _PLACE_M or abs(z - drive.wheel_radius_m) > _PLACE_M:
                yield (
                    f"joint '{name}' of drive.{side} is at ({_spaced((x, y, z))}) m, and the row's "
                    f"span_m and wheel_radius_m need y {aside_m:g} and z {drive.wheel_radius_m:g}"
                )
            rim = corners.get(joint.child, np.empty((0, 3))) - (x, y, z)
            radius_m = float(np.hypot(rim[:, 0], rim[:, 2]).max(initial=0.0))
            if abs(radius_m - drive.wheel_radius_m) > _PLACE_M:
                yield (
                    f"the collision shape of wheel '{name}' has a radius of {radius_m:.3f} m, and "
                    f"wheel_radius_m of the row is {drive.wheel_radius_m:g}"
                )
        ends = 0.5 * drive.span_m[0], -0.5 * drive.span_m[0]
        if len(names) > 1 and not math.dist((found[0], found[-1]), ends) <= 1.5 * _PLACE_M:
            yield (
                f"the joints of drive.{side} reach from x {found[0]:.3f} to {found[-1]:.3f} m, and "
                f"span_m of the row, front first, from {ends[0]:g} to {ends[1]:g}"
            )


def _collision_corners(
    root: xml.Element, tree: LinkTree, rest: dict[str, float], path: Path
) -> dict[str, Floats]:
    """Return the corners (N, 3) of the collision shapes of each link in the base link's frame."""
    places, found = tree.places(rest), {}
    for link in root.findall("link"):
        parts = []
        for element in link.findall("collision"):
            mesh = element.find("geometry/mesh")
            name = "" if mesh is None else mesh.get("filename", "")
            if mesh is not None and not name.lower().endswith(_MESHES):
                raise ValueError(f"collision mesh '{name}' must end in {', '.join(_MESHES)}")
            turn, shift = map(np.array, origin_of(element))
            parts.append(shape_of(element, path).vertices @ turn.T + shift)
        if parts:
            turn, shift = places[link.get("name", "")]
            found[link.get("name", "")] = np.concatenate(parts) @ turn.T + shift
    return found


def _outline_faults(robot: Robot, corners: dict[str, Floats]) -> Iterator[str]:
    """Yield how the box around the collision shapes differs from the row."""
    if not corners:
        yield "no link has a <collision> shape"
        return
    every = np.concatenate(list(corners.values()))
    low, high = every.min(axis=0), every.max(axis=0)
    up = robot.drive.pivot_m
    for k, (name, size_m, bottom) in enumerate(
        (
            ("length_m", robot.length_m, -0.5 * robot.length_m),
            ("width_m", robot.width_m, -0.5 * robot.width_m),
            ("height_m", robot.height_m, -up),
        )
    ):
        if not max(abs(low[k] - bottom), abs(high[k] - bottom - size_m)) <= _OUTLINE_M:
            yield (
                f"the collision shapes reach from {low[k]:.3f} to {high[k]:.3f} m along "
                f"{'xyz'[k]}, and {name} {size_m:g} of the row from {bottom:.3f} to "
                f"{bottom + size_m:.3f}"
            )


def _numbers(element: xml.Element | None, words: str, *names: str) -> list[float]:
    """Return attributes as numbers. Raises ValueError with the words for what they are."""
    if element is None:
        raise ValueError(f"{words} is missing")
    found = []
    for name in names:
        text = element.get(name, "0" if name in ("ixy", "ixz", "iyz") else "")
        try:
            found.append(float(text))
        except ValueError:
            raise ValueError(f"{words}: {name} must be a number, not '{text}'") from None
    return found


def _spaced(values: Sequence[float]) -> str:
    return " ".join(f"{round(value, 4) + 0.0:g}" for value in values)
