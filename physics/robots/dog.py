"""Table of the quadruped: published masses and lengths of a Go2, and shapes of our own.

Source of masses, lengths and limits: unitreerobotics/unitree_rl_gym,
resources/robots/go2/urdf/go2.urdf. Inertias are those of simple solids of these sizes.
"""

from __future__ import annotations

from cosim.spec.robot import DOG
from physics.robots.model import (
    Joint,
    Link,
    Model,
    Solid,
    ball_inertia,
    box_inertia,
    rod_inertia,
    torque_limits_nm,
)

HIP_AHEAD_M = 0.1934
"""Distance of the hip joints ahead of and behind the middle of the trunk."""
HIP_ASIDE_M = 0.0465
"""Distance of the hip joints from the middle plane."""
THIGH_ASIDE_M = 0.0955
"""Distance of a thigh joint from its hip joint, outwards."""
SEGMENT_M = 0.213
"""Length of thigh and calf."""
FOOT_M = 0.044
"""Diameter of a foot's ball."""
ROTOR_KGM2 = 0.006
"""Inertia of a rotor at its joint."""

_TORQUES_NM = torque_limits_nm(DOG)
_TRUNK_M = (0.376, 0.094, 0.114)
_ACROSS = (1.5707963, 0.0, 0.0)


def _leg(name: str, ahead: float, left: float) -> tuple[list[Link], list[Joint]]:
    """Return one leg.

    ahead, left: 1 or -1.
    """
    return _leg_links(name, ahead, left), _leg_joints(name, ahead, left)


def _leg_links(name: str, ahead: float, left: float) -> list[Link]:
    aside_m = left * THIGH_ASIDE_M
    half_m = 0.5 * SEGMENT_M
    return [
        Link(
            f"{name}_hip_link",
            0.678,
            (-0.0054 * ahead, 0.0, 0.0),
            rod_inertia(0.678, 0.092, 0.06),
            (Solid("cylinder", (0.092, 0.06), (0.0, 0.25 * aside_m, 0.0), _ACROSS, "dark", True),),
        ),
        Link(
            f"{name}_thigh_link",
            1.152,
            (-0.0037, -0.022 * left, -0.0273),
            box_inertia(1.152, (0.034, 0.045, 0.213)),
            (
                Solid("cylinder", (0.092, 0.055), (0.0, -0.02 * left, 0.0), _ACROSS, "dark"),
                Solid(
                    "box",
                    (0.034, 0.0245, 0.213),
                    (0.0, 0.0, -half_m),
                    (0.0, 0.0, 0.0),
                    "body",
                    True,
                ),
            ),
        ),
        Link(
            f"{name}_calf_link",
            0.154,
            (0.005, 0.0, -0.13),
            rod_inertia(0.154, 0.024, 0.213),
            (
                Solid("cylinder", (0.034, 0.03), (0.0, 0.0, 0.0), _ACROSS, "dark"),
                Solid(
                    "cylinder", (0.024, 0.19), (0.0, 0.0, -half_m), (0.0, 0.0, 0.0), "dark", True
                ),
            ),
        ),
        Link(
            f"{name}_foot",
            0.04,
            (0.0, 0.0, 0.0),
            ball_inertia(0.04, FOOT_M),
            (Solid("sphere", (FOOT_M,), colour="rubber", touches=True),),
        ),
    ]


def _leg_joints(name: str, ahead: float, left: float) -> list[Joint]:
    thigh_rad = (-1.5708, 3.4907) if ahead > 0 else (-0.5236, 4.5379)
    return [
        Joint(
            f"{name}_hip",
            "base",
            f"{name}_hip_link",
            (ahead * HIP_AHEAD_M, left * HIP_ASIDE_M, 0.0),
            axis=0,
            range_rad=(-1.0472, 1.0472),
            torque_nm=_TORQUES_NM[f"{name}_hip"],
            speed_radps=30.1,
            rotor_kgm2=ROTOR_KGM2,
        ),
        Joint(
            f"{name}_thigh",
            f"{name}_hip_link",
            f"{name}_thigh_link",
            (0.0, left * THIGH_ASIDE_M, 0.0),
            axis=1,
            range_rad=thigh_rad,
            torque_nm=_TORQUES_NM[f"{name}_thigh"],
            speed_radps=30.1,
            rotor_kgm2=ROTOR_KGM2,
        ),
        Joint(
            f"{name}_calf",
            f"{name}_thigh_link",
            f"{name}_calf_link",
            (0.0, 0.0, -SEGMENT_M),
            axis=1,
            range_rad=(-2.7227, -0.83776),
            torque_nm=_TORQUES_NM[f"{name}_calf"],
            speed_radps=20.06,
            rotor_kgm2=ROTOR_KGM2,
        ),
        Joint(f"{name}_ankle", f"{name}_calf_link", f"{name}_foot", (0.0, 0.0, -SEGMENT_M)),
    ]


def _model() -> Model:
    trunk = Link(
        "base",
        6.921,
        (0.0211, 0.0, -0.0054),
        (0.02448, 0.098077, 0.107),
        (
            Solid("box", _TRUNK_M, colour="body", touches=True),
            Solid("box", (0.30, 0.12, 0.06), (-0.01, 0.0, 0.03), colour="lid"),
            Solid("box", (0.12, 0.10, 0.09), (0.26, 0.0, 0.045), colour="body", touches=True),
            Solid("cylinder", (0.07, 0.06), (0.33, 0.0, 0.05), (0.0, 1.5707963, 0.0), "dark", True),
            Solid("cylinder", (0.08, 0.024), (0.24, 0.0, 0.088), colour="dark"),
        ),
    )
    links, joints = [trunk], []
    for name, ahead, left in (
        ("front_left", 1.0, 1.0),
        ("front_right", 1.0, -1.0),
        ("rear_left", -1.0, 1.0),
        ("rear_right", -1.0, -1.0),
    ):
        more_links, more_joints = _leg(name, ahead, left)
        links += more_links
        joints += more_joints
    return Model(
        "dog",
        "a quadruped of 15 kg. Base frame in the middle of the trunk. "
        "Written by physics.robots.make_urdf.",
        tuple(links),
        tuple(joints),
    )


DOG_MODEL = _model()
"""Links and joints of the quadruped."""
