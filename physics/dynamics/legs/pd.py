"""Torques of joints that follow target angles."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.spec.robot import Legs


def torques_nm(
    legs: Legs,
    target_rad: Sequence[float],
    angles_rad: Sequence[float],
    speeds_radps: Sequence[float],
) -> list[float]:
    """Return proportional-derivative torques within the joints' limits."""
    return [
        min(max(kp * (goal - angle) - kd * speed, -most), most)
        for kp, kd, most, goal, angle, speed in zip(
            legs.kp,
            legs.kd,
            legs.torque_nm,
            target_rad,
            angles_rad,
            speeds_radps,
            strict=True,
        )
    ]
