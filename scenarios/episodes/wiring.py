"""Wiring of an episode: starts the engines of a scenario behind their interfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.clock import Clock
from cosim.core.errors import MachineError, SpecError
from cosim.core.geometry import Pose
from cosim.core.progress import Progress
from cosim.core.state import People, RobotState, Street
from cosim.episode.interfaces import Camera, Director, Privileged, ViewCamera
from cosim.episode.loop import EpisodeEngines, Moment
from cosim.episode.observer import Observer
from cosim.episode.sensing import sensing_range_m
from cosim.people.yielding import StandingObstacles, standing_obstacles
from cosim.place import overlay
from cosim.place.barriers import without_barriers
from cosim.place.car_paths import waits_before
from cosim.place.street_map import Port, StreetMap, WalkableArea
from cosim.results.record import ScanLook
from cosim.results.run_setup import NO_RENDERER
from cosim.spec.camera import CameraSpec
from cosim.spec.events import EventKinds
from cosim.spec.manifest import Manifest
from cosim.spec.obstacle import Obstacle, footprint
from cosim.spec.options import EpisodeOptions, RendererAddress
from cosim.spec.robot import COURIER, Robot, robot_called
from cosim.spec.scenario import CrowdSpec, Scenario, event_faults
from cosim.spec.spec_file import join_faults
from cosim.spec.weather import CLEAR, WEATHERS, Weather
from physics.cameras.choice import camera_of, camera_of_choice, drawn_appearance, renderer_of
from physics.dynamics.drive import SUBSTEP_S
from physics.dynamics.drives import gait_drive
from physics.dynamics.legs.gait_file import user_gait
from physics.dynamics.world import BulletWorld
from physics.sensors.caster import RayCaster
from physics.street.furniture import Prop, footprints
from physics.street.surface import PlaceSurface, Surface
from scenarios.episodes.director import ObstacleAwareDirector, director_of
from scenarios.episodes.injected import InjectedPeople
from scenarios.episodes.scorer import Scorer
from scenarios.ipc.render_link import SharedCamera
from scenarios.places.nets import place, surface_of_place
from sumo_nets.crowd.demand_log import Entrances
from sumo_nets.crowd.empty_street import EmptyStreet, needs_no_sumo

if TYPE_CHECKING:
    from sumo_nets.crowd.crowd import SumoCrowd

CORRIDOR_M = 40.0
"""Distance in m from the route within which the walkable area is loaded; beyond it all is out of
lane."""
_BESIDE_M = 10.0
"""Distance in m from obstacles within which the walkable area is loaded for pedestrians."""
FRONTAGE_M = 2.0
"""Distance in m from a street at which injected people may still be."""


@dataclass(slots=True)
class StagedScenario:
    """A scenario whose engines run.

    renderer: name of the policy's renderer in records.
    gait_hash: hash of the files of the user's gait; "" without one.
    scan: look of a scanned place to the policy's cameras; None without either.
    observer: builds observations.
    eyes: creates further cameras.
    entrances: arrivals and departures of the crowd.
    """

    engines: EpisodeEngines
    robot: Robot
    renderer: str
    gait_hash: str
    scan: ScanLook | None
    scorer: Scorer
    observer: Observer
    eyes: Callable[[CameraSpec], AbstractContextManager[ViewCamera]]
    injected: InjectedPeople
    entrances: Entrances


@contextmanager
def staged(
    scenario: Scenario,
    manifest: Manifest,
    options: EpisodeOptions,
    seed: int,
    clock: Clock,
    waiting: Progress,
    kinds: EventKinds,
    shared: RendererAddress | None = None,
) -> Iterator[StagedScenario]:
    """Start the engines of a scenario; all are closed at the end of the block.

    seed: of the run.
    shared: shared renderer, used in place of an own camera.
    """
    if faults := list(event_faults(scenario, kinds)):
        raise SpecError(f"scenario '{scenario.id}': {join_faults(faults)}")
    _, street_map = place(scenario.place)
    walkable = street_map.walkable_near(route_corridor(scenario))
    with ExitStack() as stack:
        street = surface_of_place(scenario.place)
        robot = robot_called(scenario.robot)
        gait = user_gait(options.gait, robot, SUBSTEP_S) if options.gait else None
        motors = None if gait is None else gait_drive(robot, gait)
        grip = scenario.conditions.grip
        world = stack.enter_context(
            BulletWorld(street, scenario.barriers, robot, scenario.obstacles, motors, grip)
        )
        crowd = crowd_of(scenario)
        stack.enter_context(crowd)

        def eyes(spec: CameraSpec) -> AbstractContextManager[ViewCamera]:
            return camera_of(
                camera_of_choice(options.camera),
                world,
                spec,
                light=scenario.light,
                weather=scenario.conditions,
                depth=spec.depth,
                appearance=options.appearance,
            )

        camera, renderer = _policy_camera(stack, scenario, manifest, options, shared, eyes)
        cameras = {name: stack.enter_context(eyes(spec)) for name, spec in manifest.cameras.items()}
        rays: RayCaster | None = None
        if range_m := sensing_range_m(manifest):
            rays = stack.enter_context(
                RayCaster(street, scenario.barriers, scenario.obstacles, robot, range_m)
            )
        look = None if camera is None else partial(draw_empty_street, camera, street, robot)
        director = stack.enter_context(director_of(scenario.id, options.director, waiting, kinds))
        injected, directed = _with_people(
            director, scenario, options, street_map, street, clock, lambda: crowd.street.people
        )
        privileged = privileged_source(scenario, robot, street, street_map, walkable)
        yield StagedScenario(
            engines=EpisodeEngines(world, crowd, directed, camera),
            robot=robot,
            renderer=renderer,
            gait_hash="" if gait is None else gait.digest,
            scan=_look_of(street, renderer, options) if camera is not None or cameras else None,
            scorer=Scorer(
                scenario, kinds, street_map, WalkableArea(walkable), robot, world.occluded, clock
            ),
            observer=Observer(scenario, manifest, seed, privileged, cameras, look, rays),
            eyes=eyes,
            injected=injected,
            entrances=crowd.entrances,
        )


def route_corridor(scenario: Scenario) -> Polygon:
    """Return the ground within CORRIDOR_M of the route."""
    around: Polygon = shapely.buffer(LineString(scenario.route), CORRIDOR_M)
    return around


def privileged_source(
    scenario: Scenario,
    robot: Robot,
    street: PlaceSurface,
    street_map: StreetMap,
    walkable: Polygon | MultiPolygon,
) -> Callable[[Moment], Privileged]:
    """Return the function that gives privileged state.

    What never changes is computed at the first call, because placing all props is slow.
    """

    @cache
    def free() -> Polygon | MultiPolygon:
        return _free_ground(walkable, scenario, street.standing(route_corridor(scenario)), robot)

    @cache
    def waits_m() -> tuple[float, ...]:
        return waits_before(street_map, scenario.route_line, scenario.crossings, robot)

    return lambda now: privileged_state(scenario, free(), waits_m(), now)


def _policy_camera(
    stack: ExitStack,
    scenario: Scenario,
    manifest: Manifest,
    options: EpisodeOptions,
    shared: RendererAddress | None,
    eyes: Callable[[CameraSpec], AbstractContextManager[ViewCamera]],
) -> tuple[Camera | None, str]:
    """Start the policy's camera, or connect to the shared renderer, until `stack` is closed.

    Returns the camera, None for a policy without one, and the name of its renderer in records.
    """
    if shared is not None:
        shared_camera = stack.enter_context(SharedCamera(shared, scenario))
        if manifest.camera is not None:
            return shared_camera, shared_camera.renderer
    elif manifest.camera is not None:
        camera = stack.enter_context(eyes(manifest.camera))
        return camera, renderer_of(camera_of_choice(options.camera), options.appearance)
    return None, NO_RENDERER


def _with_people(
    director: Director,
    scenario: Scenario,
    options: EpisodeOptions,
    street_map: StreetMap,
    street: PlaceSurface,
    clock: Clock,
    people: Callable[[], People],
) -> tuple[InjectedPeople, Director]:
    """Add residents and injected people to a director, and obstacles to its queries.

    people: returns the people on the street now.
    Returns the wrapper for injections, and the outermost director.
    """
    if scenario.weathered_crowd.residents:
        # Imported only where needed: it loads scipy.
        from scenarios.events.resident_director import with_residents

        director = with_residents(director, scenario, street_map, street, people)
    injected = InjectedPeople(
        director,
        clock.tick_ms,
        partial(is_on_map, street_map),
        scenario.route_line,
        scenario.start_pose,
        options.injections,
    )
    if not scenario.obstacles:
        return injected, injected
    obstacles = pedestrian_obstacles(scenario, street_map)
    return injected, ObstacleAwareDirector(injected, obstacles, people)


def _free_ground(
    walkable: Polygon | MultiPolygon, scenario: Scenario, props: Sequence[Prop], robot: Robot
) -> Polygon | MultiPolygon:
    """Return where the robot's middle may be: the walkable area without barriers, props and
    obstacles, narrowed by half the robot's width."""
    ground = without_obstacles(
        without_barriers(walkable, scenario.barriers), props, scenario.obstacles
    )
    free = shapely.buffer(ground, -robot.width_m / 2)
    shapely.prepare(free)
    return free


def _look_of(surface: Surface, renderer: str, options: EpisodeOptions) -> ScanLook | None:
    """Return how a scanned place looks in pictures; None for other places.

    renderer: of the policy's first camera; further cameras draw in this process.
    """
    if surface.scan is None:
        return None
    facts = surface.scan.facts
    if renderer == NO_RENDERER:
        renderer = renderer_of(camera_of_choice(options.camera), options.appearance)
    appearance = drawn_appearance(renderer, surface.scan)
    return ScanLook(
        appearance=appearance,
        splats=facts.splats_hash if appearance == "splats" else "",
        sun_azimuth_deg=None if facts.sun is None else facts.sun.azimuth_deg,
        sun_elevation_deg=None if facts.sun is None else facts.sun.elevation_deg,
    )


def crowd_of(scenario: Scenario, recorded: Entrances | None = None) -> SumoCrowd | EmptyStreet:
    """Create the crowd and traffic of a scenario, not started.

    recorded: recorded arrivals and departures, used in place of random ones.
    """
    net_path, street_map = place(scenario.place)
    robot = robot_called(scenario.robot)
    start_xy = scenario.start[:2]
    if needs_no_sumo(street_map, scenario.crowd, recorded):
        return EmptyStreet(street_map, scenario.seed, start_xy)
    closed = frozenset(Port(barrier.strip, barrier.end) for barrier in scenario.barriers)
    return sumo_crowd(
        net_path,
        street_map,
        scenario.weathered_crowd,
        scenario.seed,
        closed,
        start_xy,
        robot.footprint_m,
        recorded,
        pedestrian_obstacles(scenario, street_map),
        scenario.conditions,
    )


def sumo_crowd(
    net_path: Path,
    street_map: StreetMap,
    spec: CrowdSpec,
    seed: int,
    closed: frozenset[Port],
    start_xy: tuple[float, float],
    footprint_m: tuple[float, float] = COURIER.footprint_m,
    recorded: Entrances | None = None,
    obstacles: StandingObstacles | None = None,
    weather: Weather = WEATHERS[CLEAR],
) -> SumoCrowd:
    """Create the crowd and traffic of a net by SUMO, not started. Raises MachineError if SUMO
    cannot be loaded."""
    try:
        from sumo_nets.crowd.crowd import SumoCrowd
    except (ImportError, OSError) as error:
        raise MachineError(f"SUMO cannot be loaded: {error}. `cosim doctor` says more") from error

    return SumoCrowd(
        net_path,
        street_map,
        spec,
        seed,
        closed,
        start_xy,
        footprint_m,
        recorded,
        obstacles,
        weather,
    )


def pedestrian_obstacles(scenario: Scenario, street_map: StreetMap) -> StandingObstacles:
    """Return the obstacles of a scenario as pedestrians avoid them."""
    if not scenario.obstacles:
        return StandingObstacles()
    around = shapely.union_all([footprint(one, _BESIDE_M) for one in scenario.obstacles])
    return standing_obstacles(scenario.obstacles, street_map.walkable_near(around))


def privileged_state(
    scenario: Scenario, free: Polygon | MultiPolygon, waits_m: tuple[float, ...], now: Moment
) -> Privileged:
    """Return the privileged state for an observation."""
    crossings = tuple((c.id, c.enter_s_m, c.leave_s_m) for c in scenario.crossings)
    street = now.street
    return Privileged(
        now.robot,
        scenario.route_line,
        now.route_s_m,
        street.people,
        street.vehicles,
        street.signals,
        crossings,
        free,
        waits_m,
    )


def draw_empty_street(
    camera: Camera, surface: Surface, robot: Robot, pose: Pose
) -> NDArray[np.uint8]:
    """Draw the view of a robot's camera at a pose in the empty street, (H, W, 3) uint8."""
    z_m, _, _ = surface.lean(pose, robot.drive.span_m)
    return camera.render(RobotState(pose, z_m=z_m), Street(0)).rgb


def is_on_map(street_map: StreetMap, x_m: float, y_m: float) -> bool:
    """Return whether a point is on a street, or within FRONTAGE_M of one."""
    return street_map.locate(x_m, y_m, FRONTAGE_M).kind != "off"


def without_obstacles(
    area: Polygon | MultiPolygon, props: Sequence[Prop], obstacles: Sequence[Obstacle] = ()
) -> Polygon | MultiPolygon:
    """Return an area minus the footprints of props and obstacles; the area itself if none
    intersects it."""
    ground = np.array([*footprints(props), *map(footprint, obstacles)], dtype=object)
    ground = ground[shapely.intersects(area, ground)]
    return overlay.difference(area, overlay.union_all(ground)) if len(ground) else area
