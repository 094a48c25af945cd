"""Scenes of the last seconds before a failure, from a replay of the recorded episode.

They show the positions of all bodies and the pictures of the cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Set
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import shapely

from cosim.core.clock import Clock
from cosim.core.geometry import Floats
from cosim.core.state import PersonKind, Street
from cosim.episode.interfaces import ViewCamera
from cosim.episode.loop import Step
from cosim.place.street_map import StreetMap
from cosim.report.above import street_areas
from cosim.report.encoding import image_url
from cosim.report.page.reasons import MetBody, Mishap
from cosim.report.page.scene import CrossingLight, DrawnWay, Outline, Pictures, Scene, Track
from cosim.results.referee import Verdict
from cosim.results.waypoint_replay import WaypointReplay
from cosim.spec.camera import CameraSpec
from cosim.spec.obstacle import footprint
from cosim.spec.robot import robot_called
from cosim.spec.run_config import CameraChoice
from physics.cameras.view import robot_shot
from scenarios.episodes.replay import RecordedEpisode, ReplayChecker, load_recorded, replay_episode
from scenarios.places.nets import place, surface_of_place
from scenarios.tools.viewing.drawn_route import led_to, way_in_picture
from scenarios.tools.viewing.look import eye_behind

SHOWN_S: Final = 10.0
"""Duration of the view from above, before the failure, in seconds."""
PICTURED_S: Final = 5.0
_STEP_TICKS: Final = 2
"""Ticks between samples."""
_PICTURE_TICKS: Final = 5
"""Interval of the pictures in ticks. There is one more at the failure. Consecutive failures share
pictures.
"""
START_TICKS = 400
PICTURE_TICKS = 10
"""Cost of starting the engines, and of drawing one moment, in simulated ticks."""
_PEOPLE_M: Final = 25.0
_VEHICLES_M: Final = 40.0
_GROUND_M: Final = 22.0
"""Ground that is drawn beyond the way of the robot, in metres."""
FOLLOW_PX: Final = (384, 216)
_WIDEST_PX: Final = 320
_TALLEST_PX: Final = 240
"""Largest size of the pictures of the robot's own camera, which are scaled, in pixels."""
_OVER_SAMPLES: Final = 4
"""Number of samples over which the velocity of a body is taken."""


Took = Callable[[int], None]
"""Callback for progress: the number of finished ticks, of `ticks_to_show`."""


def untimed(done: int) -> None:
    """Ignore progress; the default callback."""


class ShownAgain(NamedTuple):
    """Replayed failure with the bodies near the robot."""

    scene: Scene
    other: MetBody | None


def ticks_to_show(mishaps: Sequence[Mishap]) -> int:
    """Return how long it takes to show failures of one episode again, in ticks that could be
    simulated meanwhile."""
    pictured = set[int]().union(*map(_pictured, mishaps))
    return START_TICKS + _last_tick(mishaps) + PICTURE_TICKS * len(pictured)


def _last_tick(mishaps: Sequence[Mishap]) -> int:
    """Return the number of ticks up to the last failure."""
    return max(mishap.tick for mishap in mishaps) + 1


def _pictured(mishap: Mishap) -> frozenset[int]:
    """Return the ticks with pictures in the scene of a failure."""
    first = max(0, mishap.tick - Clock().ticks(PICTURED_S))
    return frozenset(
        range(-(-first // _PICTURE_TICKS) * _PICTURE_TICKS, mishap.tick, _PICTURE_TICKS)
    ) | {mishap.tick}


def show_again(
    folder: Path,
    scenario_id: str,
    mishaps: Sequence[Mishap],
    camera: CameraChoice,
    took: Took = untimed,
) -> list[ShownAgain]:
    """Run a recorded episode again up to the last of these failures, every tick held against the
    recorded one.

    Raises RunError when it comes out otherwise.
    """
    recorded = load_recorded(folder, scenario_id)
    _, street_map = place(recorded.scenario.place)
    following = WaypointReplay(recorded.log)
    reels = [_Reel(recorded, mishap, following.follows) for mishap in mishaps]
    last = _last_tick(mishaps)
    with ExitStack() as stack:
        episode, policy = replay_episode(recorded, camera, without_measures=True)
        stack.enter_context(episode)
        spec = robots_camera(recorded.record.manifest.camera)
        # Each camera caches the surroundings of its own place. A shared camera would rebuild them
        # for each picture.
        seen, outside = (stack.enter_context(episode.eyes(spec)) for _ in range(2))
        shots = _Shots(
            recorded,
            spec,
            seen,
            outside,
            set[int]().union(*map(_pictured, mishaps)),
            following.follows,
        )
        episode.watch(ReplayChecker(folder, recorded).watch)

        def watch(step: Step, verdict: Verdict) -> None:
            plan = following.update(step, verdict.reset is not None)
            shots.take(step, plan)
            for reel in reels:
                reel.take(step, plan)
            took(START_TICKS + step.tick + 1 + PICTURE_TICKS * len(shots))

        episode.watch(watch)
        observation = episode.reset()
        while not episode.over and episode.moment.tick < last:
            observation = episode.advance(policy.act(observation))
        return [reel.showing(street_map, episode.footprint_m, shots) for reel in reels]


def robots_camera(spec: CameraSpec | None) -> CameraSpec:
    """Return the policy's own camera, in a size for a page, or the standard one, 4:3."""
    if spec is None:
        return CameraSpec(_WIDEST_PX, _TALLEST_PX)
    zoom = min(_WIDEST_PX / spec.width, _TALLEST_PX / spec.height)
    return CameraSpec(
        round(spec.width * zoom),
        round(spec.height * zoom),
        spec.fov_deg,
        mount=spec.mount,
        lens=spec.lens,
    )


class _Moment(NamedTuple):
    """Pictures of a tick on a page: by the robot's camera and from behind, as data URLs, and the
    way ahead.
    """

    robot: str
    follow: str
    way: DrawnWay


class _Shots:
    """Pictures of an episode, each drawn once.

    spec: camera of the robot.
    seen, outside: cameras that draw.
    ticks: ticks that are drawn.
    follows: see `WaypointReplay`.
    """

    def __init__(
        self,
        recorded: RecordedEpisode,
        spec: CameraSpec,
        seen: ViewCamera,
        outside: ViewCamera,
        ticks: Set[int],
        follows: int,
    ) -> None:
        self._scenario = recorded.scenario
        self.spec = spec
        self._follows = follows
        self._seen = seen
        self._outside = outside
        self._ticks = ticks
        self._moments: dict[int, _Moment] = {}
        self._ahead: Floats = np.zeros(2)

    def __len__(self) -> int:
        return len(self._moments)

    def __getitem__(self, tick: int) -> _Moment:
        return self._moments[tick]

    def take(self, step: Step, plan: Floats | None) -> None:
        """Process one tick. plan: the waypoints that are followed (`WaypointReplay.take`)."""
        robot = step.motion.robot
        street = step.street_after
        ahead = np.array([math.cos(robot.pose.heading_rad), math.sin(robot.pose.heading_rad)])
        self._ahead = 0.9 * self._ahead + 0.1 * ahead if self._ahead.any() else ahead
        if step.tick in self._ticks:
            behind = self._outside.picture(
                *eye_behind(robot, self._ahead), street, robot, FOLLOW_PX
            ).rgb
            seen = self._seen.render(robot, street).rgb
            self._moments[step.tick] = _Moment(
                image_url(seen), image_url(behind), self._way(step, plan)
            )

    def _way(self, step: Step, plan: Floats | None) -> DrawnWay:
        """Return the followed waypoints, or the path of the command, in the robot's picture."""
        robot = step.motion.robot
        surface = surface_of_place(self._scenario.place)
        way = led_to(step.command, robot.pose) if plan is None else plan
        shot = robot_shot(surface, robot_called(self._scenario.robot), self.spec, robot)
        lines, points = way_in_picture(
            shot, self.spec.lens, np.column_stack([way, surface.heights(way)])
        )
        tenths = [_whole(10.0 * line) for line in lines]
        if plan is None:
            return DrawnWay(tenths)
        there = np.isfinite(points[:, 0]) & (np.arange(len(points)) > 0)
        follows = int(there[: self._follows].sum()) if there[self._follows] else -1
        return DrawnWay(tenths, _whole(10.0 * points[there]), follows)


class _Reel:
    """Collector of the moments before one failure. follows: see `WaypointReplay`."""

    def __init__(self, recorded: RecordedEpisode, mishap: Mishap, follows: int) -> None:
        self._scenario = recorded.scenario
        self._mishap = mishap
        self._follows = follows
        self._first = max(0, mishap.tick - Clock().ticks(SHOWN_S))
        self._first += (mishap.tick - self._first) % _STEP_TICKS
        self._pictured = _pictured(mishap)
        self._robot: list[tuple[float, ...]] = []
        self._streets: list[Street] = []
        self._plans: list[tuple[int, Floats | None]] = [(0, None)]
        self._at: list[int] = []

    def take(self, step: Step, plan: Floats | None) -> None:
        """Process one tick. plan: the waypoints that are followed (`WaypointReplay.take`)."""
        before = self._mishap.tick - step.tick
        if step.tick < self._first or before < 0:
            return
        robot = step.motion.robot
        street = step.street_after
        if before % _STEP_TICKS == 0:
            self._robot.append((*robot.pose, robot.v_mps, step.command.v_mps, step.command.w_radps))
            self._streets.append(street)
            if plan is not self._plans[-1][1]:
                self._plans.append((len(self._robot) - 1, plan))
        if step.tick in self._pictured:
            self._at.append(len(self._robot) - 1)

    def showing(
        self, street_map: StreetMap, size_m: tuple[float, float], shots: _Shots
    ) -> ShownAgain:
        """Return the whole scene, around the place of the robot at the failure."""
        track = np.array(self._robot)
        origin = np.round(track[-1, :2])
        tracks, names = self._tracks(track, origin)
        failure = self._mishap.failure
        hit = names.index(failure.other) if failure is not None and failure.other in names else -1
        robot = np.column_stack(
            [
                100.0 * (track[:, :2] - origin),
                1000.0 * track[:, 2],
                100.0 * track[:, 3:5],
                1000.0 * track[:, 5],
            ]
        )
        scene = Scene(
            step_s=Clock().time_s(_STEP_TICKS),
            end_s=Clock().time_s(self._mishap.tick + 1),
            robot=_whole(robot),
            size=(round(100.0 * size_m[0]), round(100.0 * size_m[1])),
            tracks=tracks,
            signals=self._signals(street_map, origin),
            ground=self._ground(street_map, track[:, :2], origin),
            route=_ring(self._near(np.array(self._scenario.route), track[-1, :2]), origin),
            goal=tuple(_ring(np.array([self._scenario.goal]), origin)),  # type: ignore[arg-type]
            pictures=self._pictures(shots),
            hit=hit,
            plans=[(k, [] if plan is None else _ring(plan, origin)) for k, plan in self._plans[1:]],
            follows=self._follows,
        )
        return ShownAgain(scene, None if hit < 0 else _other(track[-1], tracks[hit], origin))

    def _pictures(self, shots: _Shots) -> Pictures:
        robot, follow, ways = zip(*(shots[tick] for tick in sorted(self._pictured)), strict=True)
        return Pictures(
            self._at, list(robot), list(follow), list(ways), (shots.spec.width, shots.spec.height)
        )

    def _near(self, route: Floats, where: Floats) -> Floats:
        """Return the stretch of the route that can be in view."""
        near = np.flatnonzero(np.hypot(*(route - where).T) < 2.0 * _GROUND_M + SHOWN_S * 2.5)
        if not len(near):
            return route
        return route[max(near[0] - 1, 0) : near[-1] + 2]

    def _tracks(self, track: Floats, origin: Floats) -> tuple[list[Track], list[str]]:
        """Return the tracks of all bodies while they were near. A body that returns has a new
        track.
        """
        begun: dict[str, int] = {}
        rows: dict[tuple[str, int], list[tuple[float, float, float]]] = {}
        kinds: dict[tuple[str, int], tuple[str, tuple[int, int]]] = {}
        doing: dict[tuple[str, int], list[tuple[int, str]]] = {}
        last: dict[str, int] = {}

        def came(sample: int, name: str, at: tuple[float, float, float]) -> tuple[str, int]:
            if last.get(name) != sample - 1:
                begun[name] = sample
            last[name] = sample
            rows.setdefault((name, begun[name]), []).append(at)
            return name, begun[name]

        for sample, (street, robot) in enumerate(zip(self._streets, track, strict=True)):
            people, vehicles = street.people, street.vehicles
            for i in np.flatnonzero(np.hypot(*(people.xy - robot[:2]).T) < _PEOPLE_M).tolist():
                key = came(sample, people.ids[i], (*people.xy[i], people.heading[i]))
                kinds[key] = PersonKind(people.kind[i]).name.lower(), (60, 60)
                said = doing.setdefault(key, [])
                if not said or said[-1][1] != people.doing[i]:
                    said.append((sample, people.doing[i]))
            for i in np.flatnonzero(np.hypot(*(vehicles.xy - robot[:2]).T) < _VEHICLES_M).tolist():
                key = came(sample, vehicles.ids[i], (*vehicles.xy[i], vehicles.heading[i]))
                kinds[key] = (
                    "vehicle",
                    (round(100.0 * vehicles.size[i, 0]), round(100.0 * vehicles.size[i, 1])),
                )
        tracks = []
        names = []
        for (name, first), at in rows.items():
            kind, size = kinds[name, first]
            moved = np.array(at)
            whole = _whole(np.column_stack([100.0 * (moved[:, :2] - origin), 1000.0 * moved[:, 2]]))
            tracks.append(Track(kind, first, whole, size, doing.get((name, first), [])))
            names.append(name if last[name] == first + len(at) - 1 else "")
        return tracks, names

    def _signals(self, street_map: StreetMap, origin: Floats) -> list[CrossingLight]:
        found = []
        for crossing in self._scenario.crossings:
            if crossing.signalised:
                lights = [street.signals.get(crossing.id) for street in self._streets]
                states = "".join(
                    "-" if light is None else "g" if light.walk else "r" for light in lights
                )
                if states.strip("-"):
                    found.append(
                        CrossingLight(
                            _ring(street_map.strips[crossing.id].line[:, :2], origin), states
                        )
                    )
        return found

    def _ground(
        self, street_map: StreetMap, way: Floats, origin: Floats
    ) -> list[tuple[str, list[Outline]]]:
        (x0, y0) = (way.min(axis=0) - _GROUND_M).tolist()
        (x1, y1) = (way.max(axis=0) + _GROUND_M).tolist()
        area = shapely.box(x0, y0, x1, y1)
        shapes = [*street_areas(street_map, area)]
        for barrier in self._scenario.barriers:
            along = (
                np.array([-math.sin(barrier.heading_rad), math.cos(barrier.heading_rad)])
                * barrier.length_m
                / 2
            )
            middle = np.array([barrier.x_m, barrier.y_m])
            shapes.append(
                ("barrier", shapely.LineString([middle - along, middle + along]).buffer(0.12))
            )
        shapes += [("obstacle", footprint(obstacle)) for obstacle in self._scenario.obstacles]
        found: list[tuple[str, list[Outline]]] = []
        for kind, shape in shapes:
            parts = shapely.get_parts(shapely.simplify(shapely.intersection(shape, area), 0.03))
            polygons = [
                part for part in parts if isinstance(part, shapely.Polygon) and not part.is_empty
            ]
            found += [
                (
                    kind,
                    [_ring(np.array(ring.coords), origin) for ring in (p.exterior, *p.interiors)],
                )
                for p in polygons
            ]
        return found


def _other(robot: Floats, track: Track, origin: Floats) -> MetBody:
    """Return final position and velocity of a body near the robot. robot: (6,) of the last
    sample.
    """
    at = np.array(track.at, dtype=float).reshape(-1, 3)[-_OVER_SAMPLES - 1 :]
    xy = at[:, :2] / 100.0 + origin
    span_s = Clock().time_s(_STEP_TICKS) * (len(xy) - 1)
    velocity = (xy[-1] - xy[0]) / span_s if span_s else np.zeros(2)
    return MetBody.seen_from(robot[:3], xy[-1], velocity)


def _whole(values: Floats) -> list[int]:
    return [int(value) for value in np.round(values).ravel()]


def _ring(xy: Floats, origin: Floats) -> Outline:
    return _whole(100.0 * (xy[:, :2] - origin))
