"""Table of the humanoid: published masses and lengths of a G1, and shapes of our own.

Source of masses, lengths and limits: unitreerobotics/unitree_rl_gym,
resources/robots/g1_description/g1_12dof.urdf and g1_12dof.xml. The arms are fixed to the trunk.
"""

from __future__ import annotations

from typing import Final

from cosim.spec.robot import WALKER
from physics.robots.model import Joint, Link, Model, Solid, Triple, torque_limits_nm

ROTOR_KGM2: Final = 0.01
"""Inertia of a rotor at its joint."""
SOLE_M: Final = 0.035
"""Distance of a sole below the roll joint of its ankle, and of its middle ahead of it."""
_FOOT_HEIGHT_M: Final = 0.05
"""Height of the visible foot, and of the box that collides for it, from the underside of the sole.

Bullet pushes a box out of a triangle to its nearer side: a box as thin as the sole would fall
through the ground.
"""
_FOOT_MIDDLE_M: Final = (SOLE_M, 0.0, 0.5 * _FOOT_HEIGHT_M - SOLE_M)

_TORQUES_NM: Final = torque_limits_nm(WALKER)
_TILT_RAD: Final = 0.1749
"""Angle by which the roll and yaw joints of a hip are tilted back."""
_NONE: Triple = (0.0, 0.0, 0.0)
_ACROSS: Triple = (1.5707963, 0.0, 0.0)


def _trunk() -> Link:
    """Return trunk, head and arms as one link."""
    solids = [
        Solid("box", (0.16, 0.22, 0.30), (0.0, 0.0, 0.19), colour="body", touches=True),
        Solid("box", (0.12, 0.18, 0.10), (0.0, 0.0, 0.0), colour="dark", touches=True),
        Solid("box", (0.02, 0.16, 0.12), (0.081, 0.0, 0.25), colour="lid"),
        Solid("cylinder", (0.07, 0.08), (0.0, 0.0, 0.37), colour="dark", touches=True),
        Solid("sphere", (0.15,), (0.005, 0.0, 0.455), colour="body", touches=True),
        Solid("box", (0.03, 0.11, 0.06), (0.07, 0.0, 0.42), colour="dark"),
        Solid("box", (0.05, 0.16, 0.22), (-0.105, 0.0, 0.22), colour="lid", touches=True),
    ]
    for left in (1.0, -1.0):
        solids += [
            Solid("sphere", (0.10,), (0.0, left * 0.145, 0.29), colour="dark"),
            Solid("cylinder", (0.07, 0.22), (0.0, left * 0.16, 0.19), _NONE, "body", touches=True),
            Solid(
                "cylinder",
                (0.06, 0.20),
                (0.04, left * 0.16, -0.005),
                (0.0, -0.45, 0.0),
                "dark",
                touches=True,
            ),
            Solid("sphere", (0.08,), (0.09, left * 0.16, -0.105), colour="dark", touches=True),
        ]
    return Link("base", 17.735, (0.0145, 0.0, 0.144), (0.5527, 0.4541, 0.2118), tuple(solids))


def _leg_links(side: str, left: float) -> list[Link]:
    return [
        Link(
            f"{side}_hip_pitch_link",
            1.35,
            (0.0027, left * 0.0478, -0.0261),
            (0.00181, 0.00142, 0.00128),
            (Solid("cylinder", (0.10, 0.08), (0.0, left * 0.03, 0.0), _ACROSS, "dark"),),
        ),
        Link(
            f"{side}_hip_roll_link",
            1.52,
            (0.0298, left * -0.001, -0.0879),
            (0.00238, 0.00241, 0.00166),
            (
                Solid("sphere", (0.11,), (0.0, 0.0, 0.0), colour="dark"),
                Solid("cylinder", (0.10, 0.13), (0.015, 0.0, -0.06), _NONE, "body", True),
            ),
        ),
        Link(
            f"{side}_hip_yaw_link",
            1.702,
            (-0.0577, left * -0.011, -0.1508),
            (0.00578, 0.00761, 0.00315),
            (Solid("cylinder", (0.10, 0.19), (-0.04, 0.0, -0.09), (0.0, 0.41, 0.0), "body", True),),
        ),
        Link(
            f"{side}_knee_link",
            1.932,
            (0.0055, left * 0.004, -0.1207),
            (0.01133, 0.01128, 0.00152),
            (
                Solid("cylinder", (0.10, 0.09), (0.0, 0.0, 0.0), _ACROSS, "dark", True),
                Solid("cylinder", (0.08, 0.26), (0.005, 0.0, -0.14), _NONE, "body", True),
            ),
        ),
        Link(
            f"{side}_ankle_pitch_link",
            0.074,
            (-0.0073, 0.0, 0.0111),
            (0.000019, 0.000014, 0.000007),
            (Solid("sphere", (0.06,), colour="dark"),),
        ),
        Link(
            f"{side}_foot",
            0.608,
            (0.0265, 0.0, -0.0164),
            (0.00022, 0.00162, 0.00167),
            (
                Solid("box", (0.17, 0.06, 0.025), (SOLE_M, 0.0, -0.0225), colour="rubber"),
                Solid("box", (0.17, 0.06, _FOOT_HEIGHT_M), _FOOT_MIDDLE_M, touches=True),
                Solid("box", (0.12, 0.05, 0.03), (0.01, 0.0, 0.0), colour="body"),
            ),
        ),
    ]


def _leg_joints(side: str, left: float) -> list[Joint]:
    outer = (-0.5236, 2.9671) if left > 0 else (-2.9671, 0.5236)
    rows = (
        ("hip_pitch", (0.0, left * 0.06445, -0.1027), 0.0, 1, (-2.5307, 2.8798), 32.0),
        ("hip_roll", (0.0, left * 0.052, -0.03047), -_TILT_RAD, 0, outer, 20.0),
        ("hip_yaw", (0.025, 0.0, -0.12412), 0.0, 2, (-2.7576, 2.7576), 32.0),
        (
            "knee",
            (-0.07827, left * 0.00215, -0.17734),
            _TILT_RAD,
            1,
            (-0.08727, 2.8798),
            20.0,
        ),
        ("ankle_pitch", (0.0, left * -0.0001, -0.30001), 0.0, 1, (-0.87267, 0.5236), 37.0),
        ("ankle_roll", (0.0, 0.0, -0.01756), 0.0, 0, (-0.2618, 0.2618), 37.0),
    )
    links = ["base", *(link.name for link in _leg_links(side, left))]
    return [
        Joint(
            f"{side}_{name}",
            links[k],
            links[k + 1],
            at_m,
            (0.0, pitch_rad, 0.0),
            axis,
            range_rad,
            _TORQUES_NM[f"{side}_{name}"],
            speed_radps,
            ROTOR_KGM2,
        )
        for k, (name, at_m, pitch_rad, axis, range_rad, speed_radps) in enumerate(rows)
    ]


def _model() -> Model:
    links = [_trunk()]
    joints: list[Joint] = []
    for side, left in (("left", 1.0), ("right", -1.0)):
        links += _leg_links(side, left)
        joints += _leg_joints(side, left)
    return Model(
        "walker",
        "a humanoid of 32.1 kg. Base frame in the pelvis. Written by physics.robots.make_urdf.",
        tuple(links),
        tuple(joints),
    )


WALKER_MODEL: Final = _model()
"""Links and joints of the humanoid."""
