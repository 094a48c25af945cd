"""People as thirteen rigid parts on the same joints and poses, for renderers without skinning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from cosim.core.geometry import Floats
from cosim.core.state import People
from physics.ground.mesh import Mesh, box, frustum, join
from physics.people.appearance import family_of, look_of
from physics.people.body import COATS
from physics.people.clips import bind_of, own_clips
from physics.people.families import Family, skeleton
from physics.people.poses import poses
from physics.people.skeleton import INDEX, JOINTS, model_pose
from physics.people.wardrobe import ALL
from physics.textures.layers import Colour

RIGID_PARTS: Final = (
    ("spine2", "top"),
    ("head", "skin"),
    ("head", "hair"),
    ("left_shoulder", "top"),
    ("right_shoulder", "top"),
    ("left_elbow", "top"),
    ("right_elbow", "top"),
    ("left_wrist", "skin"),
    ("right_wrist", "skin"),
    ("left_hip", "bottom"),
    ("right_hip", "bottom"),
    ("left_knee", "bottom"),
    ("right_knee", "bottom"),
)
"""Joint and surface of each part."""

_CARRIERS: Final = [INDEX[joint] for joint, _ in RIGID_PARTS]


@dataclass(frozen=True, slots=True)
class _Placed:
    """Poses of the parts of N people.

    at_m: (N, 13, 3), metres
    turn: (N, 13, 4) quaternions x, y, z, w
    """

    at_m: Floats
    turn: Floats


@lru_cache(maxsize=4)
def part_meshes(family: Family) -> tuple[Mesh, ...]:
    """Return the parts of a family about their joints, in the modelled pose."""
    body = skeleton(family)
    _, at = bind_of(body, model_pose())
    f = body.height_m / 1.75
    joints = {name: at[k] for k, name in enumerate(JOINTS)}
    meshes = {"spine2": [_chest(joints, f)], "head": _head(joints, f)}
    for side in ("left", "right"):
        meshes |= {f"{side}_{part}": [mesh] for part, mesh in _limbs(joints, side, f).items()}
    taken = {name: iter(list_) for name, list_ in meshes.items()}
    return tuple(next(taken[joint]).moved(-joints[joint]) for joint, _ in RIGID_PARTS)


def _chest(joints: Mapping[str, Floats], f: float) -> Mesh:
    """Return the trunk from hem to neck; f: factor on the size, in all functions here."""
    base = _off(joints["neck"], 0.0, -0.03 * f)
    hem, ribs = _off(joints["pelvis"], 0.0, -0.08 * f), _off(joints["spine3"], 0.0, -0.02 * f)
    low, high = _off(base, 0.0, -0.03 * f), _off(base, 0.0, 0.03 * f)
    return join(
        [
            _tube(hem, _off(ribs, 0.0, 0.01 * f), (0.11 * f, 0.155 * f), (0.114 * f, 0.159 * f), 8),
            _tube(ribs, low, (0.115 * f, 0.16 * f), (0.08 * f, 0.17 * f), 8),
            _tube(low, high, (0.08 * f, 0.17 * f), (0.06 * f, 0.06 * f), 8),
        ]
    )


def _head(joints: Mapping[str, Floats], f: float) -> list[Mesh]:
    """Return the head with the neck, and the hair."""
    skull = _off(joints["head"], 0.0, 0.075 * f)
    nape, chin = _off(joints["neck"], 0.01, -0.05 * f), _off(joints["head"], 0.01, 0.0)
    jaw, top = _off(skull, 0.02, -0.12 * f), _off(skull, 0.0, 0.09 * f)
    thick = (0.05 * f, 0.05 * f)
    wide = (0.095 * f, 0.075 * f)
    head = join(
        [
            _tube(nape, chin, thick, thick, 5),
            _tube(jaw, skull, (0.06 * f, 0.05 * f), wide, 7),
            _tube(skull, top, wide, (0.05 * f, 0.045 * f), 7),
        ]
    )
    crown = _off(skull, -0.03 * f, 0.0)
    low, middle = _off(crown, 0.0, -0.06 * f), _off(crown, 0.012 * f, 0.06 * f)
    broad = (0.105 * f, 0.084 * f)
    hair = join(
        [
            _tube(low, middle, (0.08 * f, 0.080 * f), broad, 7),
            _tube(middle, _off(crown, 0.0, 0.112 * f), broad, (0.05 * f, 0.045 * f), 7),
        ]
    )
    return [head, hair]


def _limbs(joints: Mapping[str, Floats], side: str, f: float) -> dict[str, Mesh]:
    """Return the parts of one arm and one leg, by the joint that carries each."""
    shoulder, elbow, wrist, hand, hip, knee, ankle = (
        joints[f"{side}_{part}"]
        for part in ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle")
    )
    palm = hand + 0.9 * (hand - wrist)
    shoe = box(
        (0.275 * f, 0.09 * f, 0.075 * f),
        (ankle[0] + 0.075 * f, ankle[1], 0.0375 * f),
        skip=("bottom",),
    )
    thigh = _off(hip, 0.0, 0.03 * f)
    return {
        "shoulder": _tube(elbow, shoulder, (0.045 * f, 0.045 * f), (0.058 * f, 0.055 * f), 5),
        "wrist": _tube(palm, wrist, (0.050 * f, 0.014 * f), (0.052 * f, 0.02 * f), 4),
        "elbow": _tube(wrist, elbow, (0.028 * f, 0.028 * f), (0.042 * f, 0.042 * f), 5),
        "hip": _tube(knee, thigh, (0.06 * f, 0.06 * f), (0.095 * f, 0.085 * f), 6),
        "knee": join([_tube(ankle, knee, (0.05 * f, 0.05 * f), (0.062 * f, 0.06 * f), 5), shoe]),
    }


def placed_parts(people: People, z_m: Floats, time_s: float) -> _Placed:
    """Return the parts of N people in their poses at `time_s`.

    z_m: (N,) ground heights
    """
    clips = own_clips()
    posed = poses(people, time_s, clips)
    matrices = posed.matrices(clips)[:, _CARRIERS].astype(float)
    families = map(family_of, people.ids, people.age.tolist())
    rest = np.array([_joints(family) for family in families]).reshape(
        len(people), len(RIGID_PARTS), 3
    )
    turn = matrices[..., :3]
    at = (np.einsum("npab,npb->npa", turn, rest) + matrices[..., 3]) * posed.scale[:, None, None]
    cos, sin = np.cos(people.heading), np.sin(people.heading)
    facing = np.zeros((len(people), 1, 3, 3))
    facing[:, 0, 0, 0], facing[:, 0, 0, 1], facing[:, 0, 1, 0], facing[:, 0, 1, 1] = (
        cos,
        -sin,
        sin,
        cos,
    )
    facing[:, 0, 2, 2] = 1.0
    ground = np.column_stack([people.xy, z_m])[:, None]
    return _Placed((facing @ at[..., None])[..., 0] + ground, _quaternions(facing @ turn))


@lru_cache(maxsize=4)
def _joints(family: Family) -> Floats:
    """Return (13, 3) joint positions of the parts on the body as modelled."""
    return bind_of(skeleton(family), model_pose())[1][_CARRIERS]


@lru_cache(maxsize=4096)
def part_colours(name: str, age: int, seed: int) -> tuple[Colour, ...]:
    """Return the colours of the parts of the person of this `Age` called `name`."""
    who = look_of(name, age, seed)
    outfit = ALL[who.outfit]
    red, green, blue = (who.colours / 255.0).T.tolist()
    colours = dict(zip(COATS, zip(red, green, blue, strict=True), strict=True))
    chosen = []
    for joint, coat in RIGID_PARTS:
        if joint.endswith("knee") and outfit.bare:
            coat = "skin"
        if joint.endswith("elbow") and outfit.sleeve == "short":
            coat = "skin"
        if joint.endswith("hip") and outfit.legs == "coat":
            coat = "top"
        if coat == "hair" and outfit.cap:
            coat = "cap"
        chosen.append(colours[coat])
    return tuple(chosen)


def _quaternions(turns: Floats) -> Floats:
    """Convert (..., 3, 3) near-rotations to (..., 4) quaternions x, y, z, w.

    The bits are those of scipy's `Rotation`, whose import costs each process 0.3 s.
    """
    x = turns[..., 0] / np.linalg.norm(turns[..., 0], axis=-1, keepdims=True)
    z = np.cross(x, turns[..., 1])
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    y = np.cross(z, x)
    turned = np.stack([x, y, z], axis=-1).reshape(-1, 3, 3)
    diagonal = turned[:, range(3), range(3)]
    trace = diagonal[:, 0] + diagonal[:, 1] + diagonal[:, 2]
    largest = np.column_stack([diagonal, trace]).argmax(axis=1)
    found = np.empty((len(turned), 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows = largest == i
        turn = turned[rows]
        found[rows, i] = 1.0 - trace[rows] + 2.0 * turn[:, i, i]
        found[rows, j] = turn[:, j, i] + turn[:, i, j]
        found[rows, k] = turn[:, k, i] + turn[:, i, k]
        found[rows, 3] = turn[:, k, j] - turn[:, j, k]
    rows = largest == 3
    turn = turned[rows]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        found[rows, i] = turn[:, k, j] - turn[:, j, k]
    found[rows, 3] = 1.0 + trace[rows]
    squares = found**2
    length = np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2] + squares[:, 3])
    return np.asarray((found / length[:, None]).reshape(*turns.shape[:-2], 4))


def _off(point: Floats, ahead_m: float, up_m: float) -> Floats:
    return np.asarray(point + np.array([ahead_m, 0.0, up_m]))


def _tube(
    low: Floats,
    high: Floats,
    low_radius: tuple[float, float],
    high_radius: tuple[float, float],
    sides: int,
) -> Mesh:
    """Return a tapered prism from one point to another; its half axes are ahead and across."""
    way = high - low
    length = float(np.linalg.norm(way))
    upright = frustum(low_radius, high_radius, 0.0, length, sides)
    z = way / length
    y = np.cross(z, (1.0, 0.0, 0.0))
    y /= np.linalg.norm(y)
    turn = np.column_stack([np.cross(y, z), y, z])
    return Mesh(upright.vertices @ turn.T + low, upright.normals @ turn.T, upright.triangles)
