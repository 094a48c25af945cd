"""Gait of a neural network: observations, target angles, corrections of speed, and standing.

Commands reach the network at once, without the ramps of the robot's row: the network changes its
speed about as fast as these ramps, and stops later with ramps in front of it (docs/robots.md).

The network decides at its own rate; torques follow its targets in every substep. Without a command
a biped balances on frozen joints (`balance.py`). Other robots, and a biped with an edge between its
feet, hold their place by small commands to the network.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.core.errors import PolicyError
from cosim.core.network import Network
from cosim.core.state import Command
from cosim.spec.robot import Legs, Robot
from physics.dynamics.drive import MeasuredBody
from physics.dynamics.legs.balance import Balance, Feet, Stance
from physics.dynamics.legs.gait_manifest import (
    AngularVelocity,
    CommandTerm,
    GaitManifest,
    Gravity,
    JointAngles,
    JointSpeeds,
    LinearVelocity,
    PastActions,
    Term,
)
from physics.dynamics.legs.pd import torques_nm
from physics.robots import urdf_path
from physics.robots.kinematics import inverse, link_tree, rotate, rows_of
from physics.robots.model import Model

_HOLD_HZ: Final = 2.5
"""Speed per distance from the place that is held."""
_HOLD_MPS: Final = 0.3
"""Largest speed of a robot that holds its place, and largest integral of its error."""
_HOLD_MORE_HZ2: Final = 1.5
"""Rate of the speed per distance from the held place, against a slope that carries it off."""
_HOLD_RADPS: Final = 0.6
"""Largest yaw rate of a robot that holds its place."""
_THERE_M: Final = 0.02
"""Distance from the held place within which its error is not integrated."""
_ANCHOR_M: Final = 0.1
"""Distance from the held place above which a displaced robot holds its present place."""
_SLOW_MPS: Final = 0.08
"""Mean speed over a gait cycle below which a robot may stand."""
_SLOW_RADPS: Final = 0.1
"""Mean yaw rate over a gait cycle below which a robot may stand."""
_INTEGRAL_MOST: Final = 0.4
"""Largest integral of an error of speed, m/s or rad/s."""
_LEANS: Final = 0.2
"""Sine of the trunk's lean above which errors of speed are not integrated: the robot stumbles."""
_LEVEL_M: Final = 0.004
"""Largest distance of a foot from the ground when the joints are frozen."""
_EVEN_M: Final = 0.02
"""Height of an edge between both feet below which the ground is taken as a plane."""
_STEADY_S: Final = 2.0
"""Time of standing after which a robot that loses its balance may try to stand again."""
_HOLD_AFTER_S: Final = 0.6
"""Time without a command after which a robot that still moves holds its place."""
_STILL: Final = 1e-9


@dataclass(frozen=True, eq=False)
class NetworkSetup:
    """Gait to run: its manifest, checked against the robot, its network, and a hash of both."""

    manifest: GaitManifest
    network: Network
    digest: str


class NetworkGait:
    """Gait of one robot.

    dt_s: duration of a substep.
    """

    def __init__(
        self, robot: Robot, legs: Legs, dt_s: float, setup: NetworkSetup, model: Model
    ) -> None:
        manifest = setup.manifest
        self._manifest = manifest
        self._network = setup.network
        self._every = round(1.0 / (manifest.rate_hz * dt_s))
        self._decision_s = self._every * dt_s
        self._order = [legs.joints.index(name) for name in manifest.joints]
        rows = list(manifest.joints.values())
        self._rest = [row.rest_rad for row in rows]
        self._scales = [row.scale for row in rows]
        of = [manifest.joints[name] for name in legs.joints]
        self._gains = tuple(row.kp for row in of), tuple(row.kd for row in of)
        self._balance = None
        if manifest.balance is not None:
            stance = Stance(
                manifest.balance.ankles,
                manifest.balance.sole_m,
                tuple(row.stand_kp for row in of),
                tuple(row.stand_kd for row in of),
            )
            self._balance = Balance(model, link_tree(urdf_path(robot)), legs, stance)
        self._steady = round(_STEADY_S / dt_s)
        self.cycle_s = manifest.cycle_of(legs)
        self._cycle = max(round(self.cycle_s / self._decision_s), 1)
        self.reset()

    def reset(self) -> None:
        """Return to standing at rest."""
        self._v_mps = self._w_radps = 0.0
        self._stands = self._balance is not None
        self._frozen = False
        self._may_stand = self._balance is not None
        self._start()

    def _start(self) -> None:
        """Let the network begin, with empty memory."""
        self._memory = self._network.empty_memory()
        self._actions = [0.0] * len(self._order)
        self._count = 0
        self._v_more = self._w_more = 0.0
        self._hold_more = 0.0, 0.0
        self._past: deque[tuple[float, float, float]] = deque(maxlen=self._cycle + 1)
        self._place: tuple[float, float, float] | None = None
        self._idle_s = 0.0
        self._stood = 0
        self._steps: deque[Feet] = deque(maxlen=self._cycle)

    def step(self, command: Command, body: MeasuredBody) -> Sequence[float]:
        """Return the joints' torques in Nm for the next substep, without limits."""
        self._v_mps, self._w_radps = command.v_mps, command.w_radps
        commanded = abs(self._v_mps) > _STILL or abs(self._w_radps) > _STILL
        if self._balance is not None and self._stands:
            if not self._frozen:
                self._balance.begin(body)
                self._frozen = True
            if not commanded and self._balance.holds(body):
                self._stood += 1
                return self._balance.torques_nm(body)
            self._leave_stance(commanded)
        if self._count % self._every == 0:
            self._decide(commanded, body)
            if self._stands and self._balance is not None:
                return self._balance.torques_nm(body)
        self._count += 1
        return torques_nm(*self._gains, self._targets, body)

    def _leave_stance(self, commanded: bool) -> None:
        """Let the network walk again.

        If the robot has not stood for long, as across a slope, it marks time until it walks again.
        """
        place, more = self._place, self._hold_more
        self._may_stand = commanded or self._stood >= self._steady
        self._stands = self._frozen = False
        self._start()
        if not self._may_stand:
            self._place, self._hold_more = place, more

    def _decide(self, commanded: bool, body: MeasuredBody) -> None:
        """Query the network, or let the robot stand."""
        m = body.rotation
        x, y, _ = body.at_m
        heading = math.atan2(m[3], m[0])
        self._past.append((x, y, heading))
        if commanded:
            self._place, self._idle_s, self._may_stand = None, 0.0, self._balance is not None
            self._steps.clear()
            self._hold_more = 0.0, 0.0
            command = self._corrected(body)
        else:
            self._v_more = self._w_more = 0.0
            slow = self._is_slow()
            if self._balance is not None and self._may_stand:
                self._steps.append(self._balance.feet(body))
                if slow and self._on_both_feet():
                    self._balance.begin(body)
                    self._stands = self._frozen = self._balance.holds(body)
                if self._stands:
                    return
            self._idle_s += self._decision_s
            if self._place is not None and math.dist(self._place[:2], (x, y)) > _ANCHOR_M:
                self._place = x, y, heading
            if self._place is None and (slow or self._idle_s > _HOLD_AFTER_S):
                self._place = x, y, heading
            command = self._holding(x, y, heading)
        self._query(command, body)

    def _on_both_feet(self) -> bool:
        """Return whether both feet are on the ground.

        A robot that marks time lifts its feet in turn. Where a foot is lifted most, the other sole
        lies on the ground: both soles give its plane. On an edge the feet are lifted unequally.
        """
        if len(self._steps) < self._cycle:
            return False
        highest = max(self._steps, key=lambda one: one.apart_m[2])
        lowest = min(self._steps, key=lambda one: one.apart_m[2])
        ground = [0.5 * (a + b) for a, b in zip(highest.right, lowest.left, strict=True)]
        high, low, now = (
            math.fsum([a * b for a, b in zip(ground, one.apart_m, strict=True)])
            for one in (highest, lowest, self._steps[-1])
        )
        return abs(now) < _LEVEL_M and abs(0.5 * (high + low)) < _EVEN_M

    def _is_slow(self) -> bool:
        """Return whether the robot has hardly moved in the last gait cycle."""
        if len(self._past) <= self._cycle:
            return False
        (x0, y0, h0), (x1, y1, h1) = self._past[0], self._past[-1]
        cycle_s = self._cycle * self._decision_s
        return (
            math.hypot(x1 - x0, y1 - y0) < _SLOW_MPS * cycle_s
            and abs(_wrapped(h1 - h0)) < _SLOW_RADPS * cycle_s
        )

    def _corrected(self, body: MeasuredBody) -> tuple[float, float, float]:
        """Return speeds for the network that make the robot follow its command."""
        speed, turn = self._manifest.speed, self._manifest.turn
        m, (vx, vy, _) = body.rotation, body.velocity_mps
        ahead = (m[0] * vx + m[3] * vy) / math.hypot(m[0], m[3])
        v_more = self._v_more + speed.gain_hz * (self._v_mps - ahead) * self._decision_s
        w_more = (
            self._w_more + turn.gain_hz * (self._w_radps - body.spin_radps[2]) * self._decision_s
        )
        if math.hypot(m[6], m[7]) > _LEANS:
            v_more = w_more = 0.0
        self._v_more = min(max(v_more, -_INTEGRAL_MOST), _INTEGRAL_MOST)
        self._w_more = min(max(w_more, -_INTEGRAL_MOST), _INTEGRAL_MOST)
        v = speed.factor * self._v_mps + self._v_more
        w = turn.factor * self._w_radps + self._w_more
        return (
            min(max(v, -speed.most), speed.most),
            0.0,
            min(max(w, -turn.most), turn.most),
        )

    def _holding(self, x_m: float, y_m: float, heading_rad: float) -> tuple[float, float, float]:
        """Return speeds that bring the robot back to the place that it holds."""
        if self._place is None:
            return 0.0, 0.0, 0.0
        dx, dy = self._place[0] - x_m, self._place[1] - y_m
        if math.hypot(dx, dy) > _THERE_M:
            gain = _HOLD_MORE_HZ2 * self._decision_s
            x_more, y_more = (
                min(max(more + gain * error, -_HOLD_MPS), _HOLD_MPS)
                for more, error in zip(self._hold_more, (dx, dy), strict=True)
            )
            self._hold_more = x_more, y_more
        dx, dy = (
            _HOLD_HZ * error + more for error, more in zip((dx, dy), self._hold_more, strict=True)
        )
        cos, sin = math.cos(heading_rad), math.sin(heading_rad)
        turn = _HOLD_HZ * _wrapped(self._place[2] - heading_rad)
        wished = cos * dx + sin * dy, cos * dy - sin * dx, turn
        v, u, w = (
            min(max(one, -most), most)
            for one, most in zip(wished, (_HOLD_MPS, _HOLD_MPS, _HOLD_RADPS), strict=True)
        )
        return v, u, w

    def _query(self, command: tuple[float, float, float], body: MeasuredBody) -> None:
        """Let the network set the target angles. Raises PolicyError for NaN and infinity."""
        manifest = self._manifest
        seen = [
            term.scale * value
            for term in manifest.observation
            for value in self._observed(term, command, body)
        ]
        most = manifest.most_observed
        given = np.minimum(np.maximum(np.array(seen), -most), most).astype(np.float32)
        answer, self._memory = self._network.answer(given, self._memory)
        if any(np.abs(one).max() > manifest.most_memory for one in self._memory):
            self._memory = self._network.empty_memory()  # after a stumble it would walk askew
        values = answer.tolist()
        if not all(map(math.isfinite, values)):
            bad = [
                f"{value} for {name}"
                for name, value in zip(manifest.joints, values, strict=True)
                if not math.isfinite(value)
            ]
            raise PolicyError(f"gait '{manifest.name}' answered {', '.join(bad)}")
        most = manifest.most_answered
        self._actions = [min(max(value, -most), most) for value in values]
        targets = [0.0] * len(self._order)
        for k, rest, scale, action in zip(
            self._order, self._rest, self._scales, self._actions, strict=True
        ):
            targets[k] = rest + scale * action
        self._targets = targets

    def _observed(
        self, term: Term, command: tuple[float, float, float], body: MeasuredBody
    ) -> Sequence[float]:
        """Return the numbers of a part of the observation, before its scale."""
        m = body.rotation
        if isinstance(term, AngularVelocity):
            return rotate(inverse(rows_of(m)), body.spin_radps)
        if isinstance(term, LinearVelocity):
            return rotate(inverse(rows_of(m)), body.velocity_mps)
        if isinstance(term, Gravity):
            return -m[6], -m[7], -m[8]
        if isinstance(term, CommandTerm):
            return [scale * value for scale, value in zip(term.scales, command, strict=True)]
        if isinstance(term, JointAngles):
            return [
                body.angles_rad[k] - rest for k, rest in zip(self._order, self._rest, strict=True)
            ]
        if isinstance(term, JointSpeeds):
            return [body.speeds_radps[k] for k in self._order]
        if isinstance(term, PastActions):
            return self._actions
        turns = (
            2.0
            * math.pi
            * math.fmod(self._count // self._every * self._decision_s / term.period_s, 1.0)
        )
        return math.sin(turns), math.cos(turns)


def _wrapped(angle_rad: float) -> float:
    """Return an angle in [-pi, pi]."""
    return math.remainder(angle_rad, 2.0 * math.pi)
