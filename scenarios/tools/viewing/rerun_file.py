"""Recording of an episode for the Rerun viewer, made while its record is replayed.

    world/map/...           ground by kind, fences, obstacles, the route, the goal; static
    world/robot             pose of the robot; plan: path of its command; camera: rgb, depth,
                            labels; scan: returns of its lidar; tracks: people that it tracks
    world/waypoints         waypoints of its policy, if any; the followed one is large
    world/people, vehicles  bodies by kind; people/velocity: arrows of a second
    world/signals           red and green, over the crossings near the robot
    plots/...               speed, turn, command, gap to the nearest person, way, delay of the
                            answers; imu: the inertial sensor
    told                    events, failures and the end, as text

Timelines: `time`, simulated seconds, and `tick`. The file is written only as a whole, and only if
the replay reaches the recorded state hash.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.clock import Clock
from cosim.core.errors import unwritable
from cosim.core.files import atomic_file
from cosim.core.geometry import Floats, Pose
from cosim.core.progress import Progress, ignore
from cosim.core.state import LABELS, PERSON_RADIUS_M, RobotState, Street
from cosim.episode.interfaces import Observation, ViewCamera
from cosim.episode.loop import Step
from cosim.episode.manifest_checks import calibration_of
from cosim.place.street_map import Lane
from cosim.report.above import BARRIER, OBSTACLE, ROAD, ROUTE, VERGE
from cosim.report.legend import Rgb255
from cosim.report.minimap import COLOURS, PLANNED, RED_SIGNAL, VEHICLE
from cosim.results.referee import Verdict
from cosim.results.waypoint_replay import WaypointReplay
from cosim.spec.camera import CameraSpec
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario
from physics.cameras.posture import posture_of
from physics.robots import urdf_path
from physics.robots.kinematics import link_tree, turned
from physics.street.surface import Surface
from scenarios.episodes.replay import (
    RecordedEpisode,
    ReplayChecker,
    check_state_hash,
    load_recorded,
    replay_episode,
)
from scenarios.episodes.sensor_replay import SensorReplay, sensor_replay
from scenarios.places.nets import place, surface_of_place
from scenarios.tools.viewing.drawn_route import led_to

PICTURE_EVERY_TICKS: Final = 5
_AROUND_M: Final = 40.0
_TALL_M: Final = 1.75
_CAR_M: Final = 1.5
_LEADS_S: Final = 2.0
_PICTURES: Final = ("rgb", "depth", "labels")
_IMU_PLOTS: Final = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
_RETURN: Final[Rgb255] = (220, 40, 40)
_TRACK: Final[Rgb255] = (250, 170, 30)
_WALK: Final[Rgb255] = (214, 210, 200)
_CROSSING: Final[Rgb255] = (240, 232, 140)
_GREEN: Final[Rgb255] = (0, 170, 80)
_SPEC: Final = CameraSpec(width=192, height=144, fov_deg=75.0)
_LABEL_COLOURS: Final = (
    (135, 190, 235),
    (90, 90, 95),
    (214, 210, 200),
    (240, 232, 140),
    (170, 170, 170),
    (120, 180, 110),
    (150, 140, 120),
    (180, 120, 90),
    (210, 30, 30),
    (150, 90, 200),
    (230, 120, 0),
    (60, 80, 130),
    (20, 160, 120),
    (20, 20, 20),
)


def record_for_rerun(
    folder: Path,
    scenario_id: str,
    output: Path,
    progress: Progress = ignore,
) -> None:
    """Write the recording of a finished episode of a run.

    It has four pictures a second of the policy's camera, or of one of 192 x 144 pixels without one.

    Raises ImportError if rerun-sdk is not installed, and MachineError if the file cannot be
    written. Raises RunError if the episode does not exist or the replay differs.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    recorded = load_recorded(folder, scenario_id)
    progress("reading the street map, starting SUMO, PyBullet and the camera")
    recording = rr.RecordingStream(
        "cosim", recording_id=f"{recorded.record.scenario.id}-{recorded.record.state_hash}"
    )
    try:
        with atomic_file(output) as part:
            part.touch()
            try:
                recording.save(str(part), default_blueprint=_blueprint(rrb))
                recording.set_log_time_enabled(False)
                recording.set_log_tick_enabled(False)
                _replay_into(_RerunWriter(rr, recording, recorded), folder, recorded, progress)
                recording.flush()
            finally:
                recording.disconnect()
    except OSError as error:
        raise unwritable(output, error) from error


def _blueprint(rrb: Any) -> Any:
    """Return the layout: street on the left, pictures on the right, plots and text below."""
    camera = "world/robot/camera"
    contents = ["$origin/**", "/world/robot/plan", "/world/waypoints/**"]
    pictures = rrb.Vertical(
        *(
            rrb.Spatial2DView(origin=f"{camera}/{name}", contents=contents, name=name)
            for name in _PICTURES
        )
    )
    plots = [
        rrb.TimeSeriesView(origin=f"plots/{name}", name=name)
        for name in ("speed", "turn", "near", "way")
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(origin="world", name="street"), pictures, column_shares=[3, 1]
            ),
            rrb.Horizontal(*plots, rrb.TextLogView(origin="told", name="told")),
            row_shares=[3, 1],
        )
    )


def _replay_into(
    rerun: _RerunWriter, folder: Path, recorded: RecordedEpisode, progress: Progress
) -> None:
    spec = replace(recorded.record.manifest.camera or _SPEC, depth=True, labels=True)
    episode, policy = replay_episode(recorded)
    with episode, episode.eyes(spec) as eyes, sensor_replay(recorded) as sensors:
        surface = surface_of_place(recorded.scenario.place)
        rerun.begin(surface, spec)
        for watch in (
            ReplayChecker(folder, recorded).watch,
            lambda step, verdict: rerun.tick(step, verdict, eyes, sensors),
        ):
            episode.watch(watch)
        observation = episode.reset()
        while not episode.over:
            observation = episode.advance(policy.act(observation))
            progress(f"recording {recorded.scenario.id}", episode.moment.tick / len(recorded.log))
        check_state_hash(folder, recorded, episode.result()[0].state_hash)
    rerun.plots()


class _RerunWriter:
    """Writes into a recording. rr: the package."""

    def __init__(self, rr: Any, recording: Any, recorded: RecordedEpisode) -> None:
        self._rr = rr
        self._to = recording
        self._recorded = recorded
        self._robot = robot_called(recorded.scenario.robot)
        self._triggered: set[str] = set()
        self._middles: dict[str, Floats] = {}
        self._following = WaypointReplay(recorded.log)
        self._planned: Floats | None = None
        self._surface: Surface

    def _log(self, path: str, what: Any, static: bool = False) -> None:
        self._to.log(path, what, static=static)

    def begin(self, surface: Surface, spec: CameraSpec) -> None:
        """Log static data: the map, the robot's body and camera, names of labels."""
        rr = self._rr
        self._surface = surface
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        names = [(number, name, _LABEL_COLOURS[number]) for name, number in LABELS.items()]
        self._log("world", rr.AnnotationContext(names), static=True)
        self._map(self._recorded.scenario)
        length, width = self._robot.footprint_m
        body = rr.Boxes3D(
            half_sizes=[[length / 2, width / 2, 0.25]], centers=[[0, 0, 0.2]], colors=[(30, 30, 30)]
        )
        self._log("world/robot/body", body, static=True)
        known = calibration_of(spec, self._robot)
        camera = "world/robot/camera"
        (wide, high) = spec.size
        at = rr.Transform3D(translation=known.on_robot[:3, 3], mat3x3=known.on_robot[:3, :3])
        self._log(camera, at, static=True)
        lens = rr.Pinhole(
            image_from_camera=known.matrix,
            resolution=[wide, high],
            camera_xyz=rr.ViewCoordinates.RDF,
        )
        for name in _PICTURES:
            self._log(f"{camera}/{name}", lens, static=True)

    def _map(self, scenario: Scenario) -> None:
        rr = self._rr
        route = np.array(scenario.route)
        _, street_map = place(scenario.place)
        around = shapely.buffer(shapely.LineString(route), _AROUND_M)
        lanes = [piece for piece in street_map.near("lane", around) if isinstance(piece, Lane)]
        strips = street_map.near("strip", around)
        self._middles = {s.id: np.array(s.polygon.centroid.coords[0]) for s in strips}
        kinds: dict[str, tuple[Rgb255, Iterable[Any]]] = {
            "junctions": (ROAD, street_map.near("junction", around)),
            "roads": (ROAD, [lane for lane in lanes if lane.kind == "road"]),
            "verges": (VERGE, [lane for lane in lanes if lane.kind == "verge"]),
            "corners": (_WALK, street_map.near("corner", around)),
            "crossings": (_CROSSING, [s for s in strips if s.id.startswith(":")]),
            "sidewalks": (_WALK, [s for s in strips if not s.id.startswith(":")]),
        }
        for above, (name, (colour, pieces)) in enumerate(kinds.items()):
            corners = [self._lying(piece.polygon, street_map.terrain is None) for piece in pieces]
            if corners and len(at := np.concatenate(corners)):
                at[:, 2] += 0.004 * above  # one kind of ground never flickers through another
                every = np.arange(len(at)).reshape(-1, 3)
                ground = rr.Mesh3D(
                    vertex_positions=at, triangle_indices=every, albedo_factor=colour
                )
                self._log(f"world/map/{name}", ground, static=True)
        strip = rr.LineStrips3D([self._on_ground(route, 0.05)], colors=[ROUTE], radii=[0.06])
        self._log("world/map/route", strip, static=True)
        goal = rr.Points3D(
            self._on_ground(route[-1:], 0.3), radii=[0.3], colors=[_GREEN], labels=["goal"]
        )
        self._log("world/map/goal", goal, static=True)
        fences = [
            (b.x_m, b.y_m, b.heading_rad, (b.thickness_m, b.length_m, b.height_m))
            for b in scenario.barriers
        ]
        things = [(o.x_m, o.y_m, o.heading_rad, o.size_m) for o in scenario.obstacles]
        self._boxes("world/map/fences", fences, BARRIER, static=True)
        self._boxes("world/map/obstacles", things, OBSTACLE, static=True)

    def _boxes(
        self,
        path: str,
        boxes: list[tuple[float, float, float, tuple[float, float, float]]],
        colour: Rgb255,
        static: bool = False,
    ) -> None:
        """Return upright boxes on the ground from centre, heading, and length, width, height."""
        half = np.array([size for *_, size in boxes]).reshape(-1, 3) / 2
        at = self._on_ground(np.array([(x, y) for x, y, *_ in boxes]).reshape(-1, 2)) + half * (
            0.0,
            0.0,
            1.0,
        )
        turns = [(0.0, 0.0, math.sin(h / 2), math.cos(h / 2)) for _, _, h, _ in boxes]
        solid = self._rr.components.FillMode.Solid
        what = self._rr.Boxes3D(
            half_sizes=half, centers=at, quaternions=turns, colors=[colour], fill_mode=solid
        )
        self._log(path, what, static)

    def _lying(self, shape: Polygon | MultiPolygon, level: bool) -> Floats:
        """Return (3 T, 3) corners of triangles that cover a piece of ground.

        level: use one height for the whole piece, since its edges may have the height of
        neighbouring ground.
        """
        corners = _triangles(shape).reshape(-1, 2)
        if not level:
            return self._on_ground(corners)
        inside = shapely.get_coordinates(shape.representative_point())
        return np.column_stack([corners, np.full(len(corners), self._surface.heights(inside)[0])])

    def _on_ground(self, xy: Floats, above_m: float = 0.0) -> Floats:
        """Return (N, 3) points above_m above the ground."""
        return np.column_stack([xy, self._surface.heights(xy) + above_m])

    def tick(
        self, step: Step, verdict: Verdict, eyes: ViewCamera, sensors: SensorReplay | None
    ) -> None:
        """Log what the policy sensed at the start of a tick, and the state at its end."""
        rr = self._rr
        if sensors is not None and (seen := sensors.read(step, verdict)) is not None:
            self._to.set_time("time", duration=Clock().time_s(step.tick))
            self._to.set_time("tick", sequence=step.tick)
            self._sensed(seen)
        robot = step.motion.robot
        self._to.set_time("time", duration=Clock().time_s(step.tick + 1))
        self._to.set_time("tick", sequence=step.tick + 1)
        if robot.legs is None:
            turn = rr.RotationAxisAngle(axis=[0, 0, 1], angle=robot.pose.heading_rad)
            here = rr.Transform3D(
                translation=[robot.pose.x_m, robot.pose.y_m, robot.z_m], rotation=turn
            )
            self._log("world/robot", here)
        else:
            self._on_legs(robot)
        led = np.column_stack(
            [led_to(step.command, Pose(0.0, 0.0, 0.0), _LEADS_S), np.full(16, 0.1)]
        )
        self._log("world/robot/plan", rr.LineStrips3D([led], colors=[_GREEN], radii=[0.04]))
        self._waypoints(self._following.update(step, verdict.reset is not None))
        self._street(step.street_after, robot.pose)
        self._say(step, verdict)
        if step.tick % PICTURE_EVERY_TICKS == 0:
            frame = eyes.render(robot, step.street_after)
            camera = "world/robot/camera"
            _, jpeg = cv2.imencode(".jpg", frame.rgb[..., ::-1])
            self._log(
                f"{camera}/rgb", rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
            )
            if frame.depth is not None:
                millimetres = np.where(frame.depth < 65.0, 1000.0 * frame.depth, 0.0).astype(
                    np.uint16
                )
                self._log(f"{camera}/depth", rr.DepthImage(millimetres, meter=1000.0))
            if frame.labels is not None:
                self._log(f"{camera}/labels", rr.SegmentationImage(frame.labels))

    def _sensed(self, seen: Observation) -> None:
        """Log a scan, tracked people and a reading of the inertial sensor."""
        rr = self._rr
        if (scan := seen.scan) is not None:
            ranges = scan.ranges_m.ravel()
            hit = np.isfinite(ranges)
            points = (scan.spec.directions[:, hit] * ranges[hit]).T
            points[:, 2] += scan.spec.height_m
            self._log("world/robot/scan", rr.Points3D(points, radii=[0.04], colors=[_RETURN]))
        if (tracks := seen.people) is not None:
            feet = np.column_stack([tracks.positions_m, np.full(len(tracks.ids), 0.9)])
            ways = np.column_stack([tracks.velocities_mps, np.zeros(len(tracks.ids))])
            dots = rr.Points3D(
                feet, radii=[0.12], colors=[_TRACK], labels=[str(i) for i in tracks.ids.tolist()]
            )
            self._log("world/robot/tracks", dots)
            arrows = rr.Arrows3D(vectors=ways, origins=feet, colors=[_TRACK])
            self._log("world/robot/tracks/velocity", arrows)
        if seen.imu is not None:
            for name, value in zip(_IMU_PLOTS, np.asarray(seen.imu).tolist(), strict=True):
                self._log(f"plots/imu/{name}", rr.Scalars(value))

    def _on_legs(self, robot: RobotState) -> None:
        """Log the place of a trunk on legs, and a line for each part of the legs."""
        posture = posture_of(self._surface, self._robot, robot)
        above = np.array([0.0, 0.0, self._robot.drive.pivot_m])
        turn = turned(posture.roll_rad, posture.pitch_rad, posture.heading_rad)
        here = self._rr.Transform3D(translation=posture.at_m - turn @ above, mat3x3=turn)
        self._log("world/robot", here)
        tree = link_tree(urdf_path(self._robot))
        places = tree.places(posture.angles_rad)
        lines = [[places[link][1] + above for link in (j.parent, j.child)] for j in tree.joints]
        strips = self._rr.LineStrips3D(lines, colors=[(30, 30, 30)], radii=[0.015])
        self._log("world/robot/legs", strips)

    def _waypoints(self, plan: Floats | None) -> None:
        """Log the waypoints that are followed from now on, if they changed."""
        if plan is self._planned:
            return
        self._planned = plan
        points = self._on_ground(np.empty((0, 2)) if plan is None else plan, 0.1)
        radii = np.where(np.arange(len(points)) == self._following.follows, 0.1, 0.05)[1:]
        dots = self._rr.Points3D(points[1:], radii=radii, colors=[PLANNED])
        self._log(
            "world/waypoints/line", self._rr.LineStrips3D([points], colors=[PLANNED], radii=[0.03])
        )
        self._log("world/waypoints/points", dots)

    def _street(self, street: Street, robot: Pose) -> None:
        """Log people, vehicles and signals near the robot."""
        rr, people, vehicles = self._rr, street.people, street.vehicles
        near = people.only(np.flatnonzero(np.hypot(*(people.xy - robot.xy).T) < _AROUND_M))
        feet = self._on_ground(near.xy, PERSON_RADIUS_M)
        colours = np.array(COLOURS)[near.kind]
        tall = np.full(len(near), _TALL_M - 2 * PERSON_RADIUS_M)
        radii = np.full(len(near), PERSON_RADIUS_M)
        bodies = rr.Capsules3D(
            lengths=tall, radii=radii, translations=feet, colors=colours, labels=near.ids
        )
        self._log("world/people", bodies)
        towards = np.column_stack([np.cos(near.heading), np.sin(near.heading), np.zeros(len(near))])
        velocity = towards * near.speed[:, None]
        arrows = rr.Arrows3D(
            vectors=velocity, origins=feet + np.array([0.0, 0.0, 0.9]), colors=colours
        )
        self._log("world/people/velocity", arrows)
        rows = np.flatnonzero(np.hypot(*(vehicles.xy - robot.xy).T) < _AROUND_M).tolist()
        boxes = [(*vehicles.xy[i], vehicles.heading[i], (*vehicles.size[i], _CAR_M)) for i in rows]
        self._boxes("world/vehicles", boxes, VEHICLE)
        self._signals(
            {name: signal.walk for name, signal in street.signals.items() if name in self._middles}
        )

    def _signals(self, walk: Mapping[str, bool]) -> None:
        over = np.array([self._middles[name] for name in walk]).reshape(-1, 2)
        colours = [_GREEN if go else RED_SIGNAL for go in walk.values()]
        points = self._rr.Points3D(
            self._on_ground(over, 2.5), radii=np.full(len(over), 0.25), colors=colours
        )
        self._log("world/signals", points)

    def _say(self, step: Step, verdict: Verdict) -> None:
        """Log the events of the tick as text."""
        said: list[tuple[str, str]] = []
        for event, state in zip(self._recorded.scenario.events, step.events.states, strict=True):
            if state.phase == "acting" and event.id not in self._triggered:
                self._triggered.add(event.id)
                said.append((f"event {event.id} {event.kind}", "INFO"))
        for failure in verdict.failures:
            other = f" with {failure.other_kind} {failure.other}" if failure.other else ""
            said.append((f"{failure.kind}{other}", "ERROR"))
        said += [(f"{one.suffered} by {one.other}", "WARN") for one in verdict.walked_into]
        if verdict.ended is not None:
            said.append((f"ended: {verdict.ended}", "INFO"))
        for words, level in said:
            self._log("told", self._rr.TextLog(words, level=level))

    def plots(self) -> None:
        """Log the plots of the trajectory."""
        log = self._recorded.log
        rr = self._rr
        ticks = np.arange(1, len(log) + 1)
        columns = {
            "speed/robot": log.speed[:, 0],
            "speed/command": log.command[:, 0],
            "turn/robot": log.speed[:, 1],
            "turn/command": log.command[:, 1],
            "near/person": log.person_m,
            "near/clearance": log.clearance_m,
            "way/done": log.route_s_m,
            "way/driven": np.cumsum(log.travelled_m),
        }
        answered = log.answers[:, 0].astype(int) + 1
        every = {name: (ticks, values) for name, values in columns.items()}
        every["latency/answers"] = answered, log.answers[:, 1] * Clock().tick_s
        for name, (at, values) in every.items():
            known = np.isfinite(values)
            when = [
                rr.TimeColumn("time", duration=at[known] * Clock().tick_s),
                rr.TimeColumn("tick", sequence=at[known]),
            ]
            self._to.send_columns(
                f"plots/{name}", indexes=when, columns=rr.Scalars.columns(scalars=values[known])
            )


def _triangles(shape: Polygon | MultiPolygon) -> Floats:
    """Return (T, 3, 2) triangles that cover a polygon."""
    faces = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
    return shapely.get_coordinates(faces).reshape(-1, 4, 2)[:, :3]
