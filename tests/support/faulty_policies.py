"""A correct policy with a camera, and for each check of `cosim policy check` a faulty one."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.state import WaypointCommand
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.goal import PointGoal
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.sensors import Scan, ScanSpec, Tracks

WEIGHTS = (0.1, 0.1, 0.2, 0.6)


class Right:
    """Turns halfway to the open street and halfway to its goal, and brakes for people in yellow."""

    manifest = Manifest(
        "right",
        rate_hz=4.0,
        camera=CameraSpec(96, 64, 60.0),
        goal="route_point",
        scan=ScanSpec(rays=36),
        people="seen",
        waypoints=WaypointRule(index=2, unit_m=0.25, dt_s=0.75),
    )

    def reset(self, episode_id: str, seed: int) -> None:
        self.past: list[np.ndarray] = []

    def act(self, seen: Observation) -> np.ndarray:
        self.look(seen)
        frames = self.ordered(([self.past[0]] * len(WEIGHTS) + self.past)[-len(WEIGHTS) :])
        way = sum(w * self.open_rad(frame) for w, frame in zip(WEIGHTS, frames, strict=True))
        turn = 0.5 * way + 0.5 * self.goal_rad(seen.goal) + self.clear_rad(seen.scan)
        speed = (
            self.speed(seen)
            * self.slower(seen.people)
            * (1.0 - min(40.0 * self.yellow(frames[-1]), 1.0))
        )
        return self.waypoints(turn, speed)

    def look(self, seen: Observation) -> None:
        if seen.reset:
            self.past = []
        self.past.append(self.read(seen.rgb))

    def read(self, rgb: np.ndarray) -> np.ndarray:
        return rgb / 255.0

    def ordered(self, frames: list[np.ndarray]) -> list[np.ndarray]:
        return frames

    def columns(self, width: int) -> np.ndarray:
        return np.linspace(-0.5, 0.5, width)

    def open_rad(self, frame: np.ndarray) -> float:
        upper = frame[: len(frame) // 2].mean(axis=2)
        return float(-4.0 * (upper * self.columns(upper.shape[1])).mean() / (upper.mean() + 1e-3))

    def yellow(self, frame: np.ndarray) -> float:
        wide = frame.shape[1]
        middle = frame[:, wide // 3 : 2 * wide // 3]
        red, green, blue = np.moveaxis(middle, 2, 0)
        return float(((red > green) & (green > np.maximum(1.7 * blue, 0.15))).mean())

    def clear_rad(self, scan: Scan) -> float:
        ranges = np.minimum(scan.ranges_m[0], 10.0)
        right, left = float(ranges[1:18].mean()), float(ranges[19:].mean())
        return 0.02 * (left - right) / (left + right)

    def slower(self, people: Tracks) -> float:
        x, y = people.positions_m.T
        return 0.8 if ((x > 0.0) & (x < 5.0) & (np.abs(y) < 1.0)).any() else 1.0

    def goal_rad(self, goal: PointGoal) -> float:
        return max(min(goal.bearing_rad, 1.0), -1.0)

    def speed(self, seen: Observation) -> float:
        return 1.2

    def waypoints(self, turn: float, speed: float) -> np.ndarray:
        far = speed * 0.25 / 0.25 * np.arange(1, 6)
        return far[:, None] * np.array([math.cos(turn), math.sin(turn)])


class NanInTheDark(Right):
    def open_rad(self, frame: np.ndarray) -> float:
        with np.errstate(invalid="ignore"):
            return super().open_rad(frame) * float(frame.mean() / frame.mean())


class ByChance(Right):
    draws = np.random.default_rng(0)

    def goal_rad(self, goal: PointGoal) -> float:
        return super().goal_rad(goal) + 0.1 * self.draws.standard_normal()


class NeverForgets(Right):
    def __init__(self) -> None:
        self.past = []

    def reset(self, episode_id: str, seed: int) -> None:
        """Keeps the pictures of the previous episode."""


class GoesOnAfterReset(Right):
    def look(self, seen: Observation) -> None:
        self.past.append(self.read(seen.rgb))


class CountsFromZero(Right):
    def speed(self, seen: Observation) -> float:
        return 1.2 * min(seen.time_s / 60.0, 1.0) + 0.5


def _planner(name: str, rule: WaypointRule) -> Manifest:
    """Return the manifest of a policy with a camera that answers with waypoints by a rule."""
    return Manifest(name, camera=CameraSpec(96, 64, 60.0), goal="route_point", waypoints=rule)


class InDecimetres(Right):
    manifest = _planner("decimetres", WaypointRule(2, 2.5, 0.75))


class InTenthsOfTheTime(Right):
    manifest = _planner("tenths", WaypointRule(2, 0.25, 0.075))


class TenTimesTooShort(Right):
    manifest = _planner("short", WaypointRule(2, 0.02, 0.75))


class Backwards(Right):
    def waypoints(self, turn: float, speed: float) -> np.ndarray:
        return super().waypoints(turn, speed) * (-1.0, 1.0)


class AxesExchanged(Right):
    def waypoints(self, turn: float, speed: float) -> np.ndarray:
        return super().waypoints(turn, speed)[:, ::-1]


class Constant(Right):
    def act(self, seen: Observation) -> np.ndarray:
        return self.waypoints(0.0, 1.2)


class ScaledTwice(Right):
    def read(self, rgb: np.ndarray) -> np.ndarray:
        return (rgb / 255.0).astype(np.uint8) / 255.0


class NewestFirst(Right):
    def ordered(self, frames: list[np.ndarray]) -> list[np.ndarray]:
        return frames[::-1]


class OneBehind(Right):
    def ordered(self, frames: list[np.ndarray]) -> list[np.ndarray]:
        return [frames[0], *frames[:-1]]


class BlueForRed(Right):
    def read(self, rgb: np.ndarray) -> np.ndarray:
        return rgb[..., ::-1] / 255.0


class FromTheLeftEdge(Right):
    def columns(self, width: int) -> np.ndarray:
        return np.linspace(0.0, 1.0, width)


class PictureFlipped(Right):
    def read(self, rgb: np.ndarray) -> np.ndarray:
        return rgb[:, ::-1] / 255.0


class SeesNobody(Right):
    def slower(self, people: Tracks) -> float:
        return 1.0

    def yellow(self, frame: np.ndarray) -> float:
        return 0.0


class DividesByTheDistance(Right):
    def speed(self, seen: Observation) -> float:
        return 12.0 / max(seen.goal.distance_m, 0.1)


class TurnsByMetres(Right):
    def goal_rad(self, goal: PointGoal) -> float:
        return 0.1 * goal.y_m


class YToTheRight(Right):
    def goal_rad(self, goal: PointGoal) -> float:
        return -super().goal_rad(goal)


class DrivesOtherwiseThanPlanned(Right):
    """Its waypoints are right, and its command, which is driven, turns the other way."""

    def act(self, seen: Observation) -> WaypointCommand:
        way = super().act(seen)
        turn = math.atan2(way[0, 1], way[0, 0])
        return WaypointCommand(float(np.hypot(*way[0])), -turn, (0.25 * way).astype(np.float32), 2)


class GoalIgnored(Right):
    def goal_rad(self, goal: PointGoal) -> float:
        return 0.0


class LidarIgnored(Right):
    def clear_rad(self, scan: Scan) -> float:
        return 0.0


class LooksBack(Right):
    """Counts the picture before the newest most, and still older ones less, as memories do."""

    def ordered(self, frames: list[np.ndarray]) -> list[np.ndarray]:
        return [frames[0], frames[3], frames[1], frames[2]]


class TracksIgnored(Right):
    def slower(self, people: Tracks) -> float:
        return 1.0


FAULTS = {
    "finite": (NanInTheDark,),
    "determinism": (ByChance,),
    "history_reset": (NeverForgets,),
    "time_step": (CountsFromZero,),
    "unit": (InDecimetres, InTenthsOfTheTime, TenTimesTooShort),
    "behind": (Backwards, AxesExchanged),
    "constant": (Constant,),
    "picture_ignored": (ScaledTwice,),
    "lidar_ignored": (LidarIgnored,),
    "frame_order": (NewestFirst, OneBehind),
    "colour_order": (BlueForRed,),
    "mirror": (FromTheLeftEdge,),
    "side": (PictureFlipped,),
    "goal_zero": (DividesByTheDistance,),
    "goal_scaled": (TurnsByMetres,),
    "goal_mirrored": (YToTheRight, DrivesOtherwiseThanPlanned),
    "goal_ignored": (GoalIgnored,),
}
"""Faulty policies by the check that must fail."""
DOUBTS = {
    "put_back": GoesOnAfterReset,
    "frame_order": LooksBack,
    "person": SeesNobody,
    "people_ignored": TracksIgnored,
}
"""Questionable policies by the check that must warn."""
