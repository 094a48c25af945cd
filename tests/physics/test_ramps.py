"""Curb ramps and curbs of generated cities under the robot's wheels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString

from cosim.core.clock import Clock
from cosim.core.errors import MapError
from cosim.core.geometry import Polyline, Pose, wrap_angle
from cosim.core.state import NO_PEOPLE, NO_VEHICLES, STILL, Command, Street
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.loop import place_on_route
from cosim.episode.policy_caller import PolicyCaller
from cosim.place.route_line import way_line
from cosim.place.street_map import Port, StreetMap, Strip, WalkableArea
from cosim.policies.privileged.route import Route
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City
from physics.dynamics.world import BulletWorld
from physics.ground.tiles import CURB_M, RAMP_SLOPE, build_tile, tile_at, tile_bounds
from physics.street.street_surface import StreetSurface
from sumo_nets.city.store import city_net
from sumo_nets.net.snapshot import street_map_of

pytestmark = pytest.mark.engine

CITIES = (City(seed=11, size_m=600.0), City(seed=23, size_m=600.0, style="suburb"))
CLIMBS_PER_CITY = 3
CURBS_PER_CITY = 3
V_MPS = 1.3
FULL_MPS = 2.5
TICK_S = 0.05


@pytest.fixture(scope="module", params=CITIES, ids=[city.name for city in CITIES])
def place(request: pytest.FixtureRequest) -> StreetMap:
    return street_map_of(city_net(request.param))


def climbs(
    place: StreetMap, count: int, rng: np.random.Generator
) -> Iterator[tuple[str, Polyline]]:
    """Yield lines from the middle of a crossing over its ramp onto a sidewalk next to its corner."""
    crossings = [strip for strip in place.strips.values() if strip.kind == "crossing"]
    order = rng.permutation(len(crossings)).tolist()
    found = 0
    for k in order:
        if found == count:
            return
        crossing = crossings[k]
        end = int(rng.integers(2))
        corner = place.corners[crossing.corners[end] or ""]
        beside = [p for p in corner.ports if place.strips[p.strip].kind == "sidewalk"]
        leave = Port(crossing.id, 1 if end else 0)
        try:
            line = way_line(
                place,
                [leave, beside[int(rng.integers(len(beside)))]],
                0.45 * crossing.length_m,
                4.0,
            )
        except MapError:
            continue
        found += 1
        yield crossing.id, line


class Climb(NamedTuple):
    """Outcome of a climb: seconds, slowest metres in any second while driving, metres left, largest
    tilt."""

    time_s: float
    slowest_m: float
    left_m: float
    tilt_rad: float


def climb(world: BulletWorld, line: Polyline) -> Climb:
    """Drive a line with the `route` policy at its own rate, in an empty street."""
    state = world.place(Pose(*line.at(0.0)))
    street = Street(0)
    clock = Clock.for_rate(Route.manifest.rate_hz)
    driver = PolicyCaller(Route())
    command = STILL
    tick = 0
    free = shapely.buffer(LineString(line.points), 1.0)
    track = [state.pose.xy]
    tilt = 0.0
    reached = 0.0
    while reached < line.length_m - 0.4 and clock.time_s(tick) < 5.0 + 2.5 * line.length_m / V_MPS:
        if clock.acts(tick):
            known = Privileged(state, line, reached, NO_PEOPLE, NO_VEHICLES, {}, (), free)
            seen = Observation(
                tick, clock.time_s(tick), None, state.v_mps, state.w_radps, COURIER, known
            )
            command = driver.act(seen)
        state = world.step(command, street, street, clock.substeps).robot
        reached = place_on_route(line, state.pose, reached)
        tilt = max(tilt, state.tilt_rad)
        tick = tick + 1
        track.append(state.pose.xy)
    steps = np.array(track)
    second = round(1.0 / TICK_S)
    moved = np.hypot(*(steps[second:] - steps[:-second]).T)
    return Climb(
        clock.time_s(tick), float(moved[second:].min(initial=1.0)), line.length_m - reached, tilt
    )


def test_route_climbs_every_ramp(place: StreetMap) -> None:
    """From crossings onto corners and sidewalks `route` arrives and never stands still for a
    second."""
    done = 0
    with BulletWorld(StreetSurface(place, seed=3)) as world:
        for name, line in climbs(place, CLIMBS_PER_CITY, np.random.default_rng(5)):
            outcome = climb(world, line)
            assert outcome.left_m < 0.5 and outcome.slowest_m > 0.05, (name, outcome)
            assert outcome.tilt_rad < math.atan(1.0 / 12.0) + 0.03, (name, outcome)
            done += 1
    assert done == CLIMBS_PER_CITY


def test_ramps_rise_one_in_twelve_at_most(place: StreetMap) -> None:
    """The height function is nowhere steeper, and few of the triangles are, where facets round the
    flares."""
    spots = [s.line[0, :2] for s in place.strips.values() if s.kind == "crossing"][:6]
    spots += [Polyline(s.line).at(at).xy for s in place.strips.values() for at in s.driveways][:6]
    rng = np.random.default_rng(1)
    steep_m2 = 0.0
    total_m2 = 0.0
    for key in dict.fromkeys(tile_at(*spot) for spot in spots):
        tile = build_tile(place, key)
        x0, y0, x1, y1 = tile_bounds(key)
        at = rng.uniform((x0, y0), (x1 - 0.1, y1 - 0.1), (4000, 2))
        rise = np.abs(tile.height(at + 0.05) - tile.height(at))
        curb = np.minimum(tile.height(at), tile.height(at + 0.05)) < 1e-9
        assert rise[~curb].max() <= 0.05 * math.sqrt(2.0) * RAMP_SLOPE + 1e-9
        for name, mesh in tile.parts.items():
            if name.startswith("ramp"):
                corners = mesh.vertices[mesh.triangles]
                normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                steep = np.hypot(normal[:, 0], normal[:, 1]) > 1.1 * RAMP_SLOPE * normal[:, 2]
                steep_m2 += 0.5 * float(normal[steep, 2].sum())
                total_m2 += 0.5 * float(normal[:, 2].sum())
    assert total_m2 > 50.0
    assert steep_m2 < 0.03 * total_m2


def curbs(
    place: StreetMap, count: int, rng: np.random.Generator
) -> Iterator[tuple[Strip, Pose, Pose]]:
    """Yield a sidewalk, a pose on it, and one on the road, facing each other over a curb far from
    ramps and driveways."""
    sidewalks = [
        s
        for s in place.strips.values()
        if s.kind == "sidewalk" and s.length_m > 24.0 and not s.driveways
    ]
    for k in rng.permutation(len(sidewalks))[:count].tolist():
        strip = sidewalks[k]
        x, y, heading = Polyline(strip.line[:, :2]).at(0.5 * strip.length_m)
        to_road = heading + strip.road_side * math.pi / 2.0
        ahead = np.array([math.cos(to_road), math.sin(to_road)])
        road = np.array([x, y]) + (0.5 * strip.width_m + strip.verge_m + 2.2) * ahead
        yield (
            strip,
            Pose(x, y, to_road),
            Pose(float(road[0]), float(road[1]), wrap_angle(to_road + math.pi)),
        )


def test_the_robot_does_not_climb_curbs_and_falls_only_off_the_walkable_area(
    place: StreetMap,
) -> None:
    """At full speed it stays below a curb; driven off a curb it leaves the walkable area before it
    falls."""
    street = Street(0)
    with BulletWorld(StreetSurface(place, seed=3)) as world:
        found = [*curbs(place, CURBS_PER_CITY, np.random.default_rng(6))]
        assert len(found) == CURBS_PER_CITY
        for strip, on_walk, on_road in found:
            area = WalkableArea(place.walkable_near(strip.polygon.buffer(10.0)))
            world.place(on_road)
            states = [
                world.step(Command(FULL_MPS, 0.0), street, street, 10).robot for _ in range(60)
            ]
            assert max(s.z_m for s in states) < 0.5 * CURB_M, strip.id
            assert not area.contains(*states[-1].pose.xy), strip.id
            world.place(on_walk)
            for _ in range(80):
                state = world.step(Command(FULL_MPS, 0.0), street, street, 10).robot
                if state.z_m < 0.5 * CURB_M:
                    break
            assert not area.contains(*state.pose.xy), strip.id
