"""Torques of joints that follow target angles."""

from __future__ import annotations

from collections.abc import Sequence

from physics.dynamics.drive import MeasuredBody


def torques_nm(
    kp: Sequence[float], kd: Sequence[float], target_rad: Sequence[float], body: MeasuredBody
) -> list[float]:
    """Return proportional-derivative torques in Nm, without limits.

    kp, kd: gains in Nm/rad and Nm s/rad
    """
    return [
        stiff * (goal - angle) - damping * speed
        for stiff, damping, goal, angle, speed in zip(
            kp, kd, target_rad, body.angles_rad, body.speeds_radps, strict=True
        )
    ]
