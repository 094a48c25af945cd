"""The only wiring of engines: a scenario and a policy become running Parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial

import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon

from cosim.core.clock import Clock
from cosim.episode.driver import Driver
from cosim.episode.loop import Parts
from cosim.episode.ports import CameraSpec, Eyes, Policy
from cosim.judge.traffic import Roadway
from cosim.place import overlay
from cosim.place.street_map import Port, StreetMap, WalkableArea
from cosim.records.record import NO_RENDERER
from cosim.spec.injection import Injected
from cosim.spec.scenario import Scenario
from physics.cameras.choice import CameraChoice, camera_of, chosen, renderer_of
from physics.street.furniture import Prop, footprints
from physics.world.world import BulletWorld
from scenarios.builders.barriers import fenced
from scenarios.execution.directing import Direct, directed
from scenarios.execution.injected import Guests
from scenarios.execution.places import place
from scenarios.residents.director import among_residents
from sumo_nets.crowd.crowd import SumoCrowd
from sumo_nets.crowd.demand_log import Entrances

CORRIDOR_M = 40.0
"""The walkable area is judged this far around the route; beyond it everything is out of lane."""


FRONTAGE_M = 2.0
"""Beside a sidewalk there is room for this much."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A scenario ready to run. area: where the robot may be, for the referee. renderer: what draws for the policy.
    eyes: makes further cameras. guests: takes injected pedestrians in. roadway: watches the robot among vehicles.
    entrances: who comes and goes in the street."""

    parts: Parts
    area: WalkableArea
    clock: Clock
    renderer: str
    eyes: Callable[[CameraSpec], AbstractContextManager[Eyes]]
    guests: Guests
    roadway: Roadway
    entrances: Entrances


@contextmanager
def staged(
    scenario: Scenario,
    policy: Policy,
    choice: CameraChoice = "auto",
    script: Sequence[Injected] = (),
    direct: Direct = directed,
) -> Iterator[Stage]:
    """Start every engine of a scenario; all are closed at the end, whatever happened.

    choice: what draws pictures. script: pedestrians that were injected into the episode that is replayed.
    direct: gives the director of its event pedestrians.
    """
    driver = Driver.of(policy)
    manifest = driver.manifest
    clock = Clock.for_rate(manifest.rate_hz)
    net_path, street_map = place(scenario.place)
    around = shapely.buffer(LineString(scenario.route), CORRIDOR_M)
    walkable = street_map.walkable_near(around)
    closed = frozenset(Port(barrier.strip, barrier.end) for barrier in scenario.barriers)
    with ExitStack() as stack:
        world = BulletWorld(
            street_map, scenario.place.seed, scenario.barriers, scenario.robot, scenario.place.unevenness
        )
        stack.enter_context(world)
        crowd = SumoCrowd(
            net_path, street_map, scenario.crowd, scenario.seed, closed, scenario.start[:2], world.footprint_m
        )
        stack.enter_context(crowd)

        def eyes(spec: CameraSpec) -> AbstractContextManager[Eyes]:
            return camera_of(chosen(choice), world, spec, light=scenario.light)

        camera, renderer = None, NO_RENDERER
        if manifest.camera is not None:
            camera, renderer = stack.enter_context(eyes(manifest.camera)), renderer_of(chosen(choice))
        director = stack.enter_context(direct(scenario.id))
        director = among_residents(director, scenario, street_map, world.ground, lambda: crowd.street.people)
        half_width_m = world.footprint_m[1] / 2
        footing = clear_of(fenced(walkable, scenario.barriers), world.ground.standing(around))
        free = shapely.buffer(footing, -half_width_m)
        shapely.prepare(free)
        guests = Guests(director, clock.tick_ms, partial(on_map, street_map), script)
        roadway = Roadway(street_map, clock.tick_s)
        parts = Parts(world, crowd, guests, driver, camera, free)
        yield Stage(parts, WalkableArea(walkable), clock, renderer, eyes, guests, roadway, crowd.entrances)


def on_map(street_map: StreetMap, x_m: float, y_m: float) -> bool:
    """Whether somebody may be there: on a street, or within FRONTAGE_M of one."""
    return street_map.locate(x_m, y_m, FRONTAGE_M).kind != "off"


def clear_of(area: Polygon | MultiPolygon, props: Sequence[Prop]) -> Polygon | MultiPolygon:
    """An area minus the ground that props cover; the area itself where none stands on it."""
    ground = footprints(props)
    ground = ground[shapely.intersects(area, ground)]
    return overlay.difference(area, overlay.union_all(ground)) if len(ground) else area
