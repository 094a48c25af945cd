"""Lidar rays and tracked people against an exact ray caster, and their limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager

import msgspec
import numpy as np
import pytest
import trimesh

from cosim.core.geometry import Floats, Pose
from cosim.core.state import People, RobotState, Street, Trunk, Vehicles
from cosim.spec.obstacle import Obstacle
from cosim.spec.robot import COURIER
from cosim.spec.scenario import Barrier, City, CityMap, CrowdSpec
from cosim.spec.sensors import ScanSpec
from physics.dynamics.bodies import PERSON_HEIGHT_M, VEHICLE_HEIGHT_M, Bodies, building_boxes
from physics.dynamics.client import BulletClient
from physics.ground.tiles import tiles_within
from physics.robots.kinematics import attitude
from physics.sensors.caster import RayCaster, sensor_frame
from physics.sensors.triangles import TriangleRays
from physics.street.furniture import Prop, solids_of
from physics.street.scan_surface import ScanSurface
from physics.street.street_surface import StreetSurface
from physics.street.surface import Surface, grounded_obstacles
from scenarios.places.nets import place, surface_of_place
from scenarios.tools.verify.doctor import small_scenario
from tests.physics.test_scan_surface import sloped_scan
from tests.support.tiny_street import tiny_map
from tests.support.tracked import reports

pytestmark = pytest.mark.engine

RANGE_M = 20.0
SPEC = ScanSpec(rays=32, range_m=RANGE_M, rings=3, elevation_deg=(-12.0, 6.0))


def exact_distances(origin: Floats, rays: Floats, triangles: Floats) -> Floats:
    """Return the (N,) distances of rays (3, N) to (T, 3, 3) triangles, ray by ray."""
    a, one, two = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    to = origin - a
    across = np.cross(to, one)
    found = []
    for ray in rays.T:
        h = np.cross(ray, two)
        det = (one * h).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (to * h).sum(axis=1) / det
            v = across @ ray / det
            t = (two * across).sum(axis=1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
        found.append(t[hit].min(initial=math.inf))
    return np.array(found)


def upright(kind: str, size: tuple[float, ...], at: tuple[float, ...], heading: float) -> Floats:
    """Return the triangles of a box (length, width, height) or cylinder (radius, height) on its
    foot."""
    turn = trimesh.transformations.rotation_matrix(heading, (0, 0, 1))
    turn[:3, 3] = (at[0], at[1], at[2] + 0.5 * size[-1])
    if kind == "box":
        return np.asarray(trimesh.creation.box(size, turn).triangles)
    return np.asarray(trimesh.creation.cylinder(*size, sections=360, transform=turn).triangles)


def all_triangles(surface: Surface, at: Pose, street: Street, static: list[Floats]) -> Floats:
    """Return the triangles of everything around a pose."""
    found = list(static)
    for key in tiles_within(at.x_m, at.y_m, 1.5 * RANGE_M):
        chunk = surface.chunk(key)
        meshes = [*(patch.mesh for patch in chunk.ground), *chunk.standing]
        found += [mesh.vertices[mesh.triangles] for mesh in meshes]
        for building in chunk.buildings:
            found += [
                upright("box", size, foot, turn) for foot, turn, size in building_boxes(building)
            ]
        for prop, z in chunk.props:
            found += prop_triangles(prop, z)
    people, vehicles = street.people, street.vehicles
    for (x, y), z in zip(people.xy.tolist(), surface.heights(people.xy).tolist(), strict=True):
        found.append(upright("cylinder", (0.3, PERSON_HEIGHT_M), (x, y, z), 0.0))
    feet = surface.road(vehicles.xy, vehicles.heading, vehicles.size)[:, 0]
    for k, z in enumerate(feet.tolist()):
        size = (*vehicles.size[k].tolist(), VEHICLE_HEIGHT_M)
        found.append(upright("box", size, (*vehicles.xy[k], z), float(vehicles.heading[k])))
    return np.concatenate(found)


def prop_triangles(prop: Prop, z: float) -> list[Floats]:
    """Return the triangles of the solids of a prop."""
    found = []
    cos, sin = math.cos(prop.heading_rad), math.sin(prop.heading_rad)
    for solid in solids_of(prop.kind, prop.variant):
        (u, v), (length, _, height) = solid.at_m, solid.size_m
        at = prop.x_m + cos * u - sin * v, prop.y_m + sin * u + cos * v, z
        size = solid.size_m if solid.shape == "box" else (0.5 * length, height)
        found.append(upright(solid.shape, size, at, prop.heading_rad))
    return found


def a_street(draws: np.random.Generator, at: Pose) -> Street:
    """Return twelve people and two cars around a pose."""
    xy = np.array(at[:2]) + draws.uniform(-12.0, 12.0, (12, 2))
    xy = xy[np.hypot(*(xy - at[:2]).T) > 0.5]
    ids = tuple(f"p{k}" for k in range(len(xy)))
    people = People.of(ids, xy, draws.uniform(-3, 3, len(xy)), [1.0] * len(xy), ("walk",) * len(xy))
    cars = [(at.x_m + 7.0, at.y_m + 6.0), (at.x_m - 8.0, at.y_m + 9.0)]
    vehicles = Vehicles.of(("a", "b"), cars, draws.uniform(-3, 3, 2), [0.0, 0.0], [[4.5, 1.8]] * 2)
    return Street(0, people, vehicles)


def leaning(surface: Surface, draws: np.random.Generator, at: Pose, lean_rad: float) -> RobotState:
    """Return a robot at a pose whose trunk leans at random."""
    z = float(surface.heights([at[:2]])[0])
    roll, pitch = (lean_rad * draws.standard_normal(2)).tolist()
    still = (0.0, 0.0, 0.0)
    return RobotState(at, z_m=z, trunk=Trunk(attitude(roll, pitch, at.heading_rad), still, still))


@contextmanager
def rays_on(
    surface: Surface, barriers: tuple[Barrier, ...] = (), obstacles: tuple[Obstacle, ...] = ()
) -> Iterator[RayCaster]:
    with RayCaster(surface, barriers, obstacles, COURIER, RANGE_M) as rays:
        yield rays


def poses_in(kind: str, draws: np.random.Generator) -> tuple[Surface, list[Pose]]:
    """Return a surface and poses on it."""
    if kind == "scan":
        at = [(-3.0, 1.0), (4.0, -5.0)]
        return ScanSurface(tiny_map(), sloped_scan(), 0), [Pose(x, y, 0.4) for x, y in at]
    spec = City(seed=5, size_m=200.0) if kind == "generated" else CityMap(map="berlin-3")
    _, street_map = place(spec)
    lines = [strip.line for strip in street_map.strips.values() if strip.kind == "sidewalk"]
    middles = [line[len(line) // 2] for line in lines]
    chosen = draws.choice(len(middles), 3, replace=False).tolist()
    heading = draws.uniform(-3.0, 3.0, 3).tolist()
    poses = [Pose(*middles[i].tolist(), turn) for i, turn in zip(chosen, heading, strict=True)]
    return surface_of_place(spec), poses


@pytest.mark.parametrize("kind", ["generated", "imported", "scan"])
def test_a_scan_equals_an_exact_ray_caster(kind: str) -> None:
    """All distances of 3 rings over streets, people and cars are those of all triangles, level and
    leaning."""
    draws = np.random.default_rng(3)
    surface, poses = poses_in(kind, draws)
    with rays_on(surface) as rays:
        for at in poses:
            street = a_street(draws, at)
            robot = leaning(surface, draws, at, 0.05)
            got = rays.distances(robot, street, SPEC.height_m, SPEC.directions, RANGE_M)
            origin, turn = sensor_frame(surface, COURIER, robot, SPEC.height_m)
            world = np.array(turn) @ SPEC.directions
            want = exact_distances(np.array(origin), world, all_triangles(surface, at, street, []))
            want[want > RANGE_M] = np.inf
            apart = (
                np.abs(np.nan_to_num(got, posinf=99.0) - np.nan_to_num(want, posinf=99.0)) > 2e-3
            )
            assert apart.sum() <= 1, (at, np.flatnonzero(apart), got[apart], want[apart])
            assert np.isfinite(got).sum() > 40


def test_a_scan_equals_the_rays_of_the_physics() -> None:
    """Barriers, obstacles, buildings and props are where the physics has them, within 1 cm."""
    surface = StreetSurface(tiny_map(), seed=0)
    fence = Barrier(x_m=-16.0, y_m=5.0, heading_rad=0.3, length_m=3.0, strip="nw", end=0)
    box = Obstacle(kind="planter", x_m=-22.0, y_m=4.0, heading_rad=0.7)
    at = Pose(-19.0, 5.0, 0.2)
    with rays_on(surface, (fence,), (box,)) as rays:
        robot = leaning(surface, np.random.default_rng(0), at, 0.02)
        got = rays.distances(robot, Street(0), 0.3, ScanSpec().directions, RANGE_M)
        origin, turn = sensor_frame(surface, COURIER, robot, 0.3)
    bodies = Bodies(COURIER, 0.005)
    for key in tiles_within(at.x_m, at.y_m, 1.5 * RANGE_M):
        bodies.add_chunk(surface.chunk(key))
    foot = surface.foot(fence.x_m, fence.y_m, fence.heading_rad, (fence.thickness_m, 3.0))
    bodies.add_barrier(fence, foot)
    for prop, z in grounded_obstacles((box,), surface):
        bodies.add_prop(prop, z)
    bodies.place_robot((0.0, 0.0, -30.0), (0.0, 0.0, 0.0))
    begin = np.tile(origin, (360, 1))
    ends = begin + RANGE_M * (np.array(turn) @ ScanSpec().directions).T
    want = RANGE_M * bodies.hit_shares(begin, ends)
    bodies.close()
    same = np.isclose(got, want, rtol=0.0, atol=0.01)
    assert same.mean() > 0.99
    near = np.isfinite(got)
    assert near.sum() > 100 and got[near].min() < 3.0


def test_array_rays_equal_pybullet_rays_to_the_bit() -> None:
    """20,000 rays, more than one call of Bullet takes, are compared after a tile was removed and
    added again."""
    surface, (at, _) = poses_in("scan", np.random.default_rng(0))
    meshes = [
        mesh
        for key in tiles_within(at.x_m, at.y_m, RANGE_M)
        for chunk in [surface.chunk(key)]
        for mesh in (*(patch.mesh for patch in chunk.ground), *chunk.standing)
    ]
    draws = np.random.default_rng(1)
    begin = np.array([at.x_m, at.y_m, 1.0]) + draws.normal(0.0, 0.2, (20_000, 3))
    end = begin + draws.normal(0.0, [10.0, 10.0, 2.0], begin.shape)
    with closing(TriangleRays()) as rays, closing(BulletClient()) as bullet:
        rays.remove(rays.add(meshes[0]))
        for mesh in meshes:
            rays.add(mesh)
            bullet.add_concave(mesh)
        got = rays.hit_shares(begin, end)
        want = [bullet.hit_shares(begin[i : i + 10_000], end[i : i + 10_000]) for i in (0, 10_000)]
    assert np.array_equal(got, np.concatenate(want))
    assert 5_000 < np.isfinite(got).sum() < 19_000


def test_the_robot_and_distant_objects_have_no_returns() -> None:
    """On an open street the only return is that of a person 18 m away, at the distance of the
    cylinder's face."""
    surface = StreetSurface(tiny_map(), seed=0)
    people = People.of(("far", "out"), [(12.0, 1.0), (16.0, 1.0)], [0, 0], [0, 0], ("stand",) * 2)
    at = Pose(-6.0, 1.0, 0.0)
    with rays_on(surface) as rays:
        robot = leaning(surface, np.random.default_rng(0), at, 0.0)
        ahead = np.array([[1.0], [0.0], [0.0]])
        found = rays.distances(robot, Street(0, people), 0.6, ahead, RANGE_M)
        nothing = rays.distances(robot, Street(0), 0.6, ahead, RANGE_M)
        short = rays.distances(robot, Street(0, people), 0.6, ahead, 10.0)
    assert found == pytest.approx([17.7])
    assert np.isinf([*nothing, *short]).all()


@pytest.mark.parametrize(
    ("at", "seen"),
    [((-12.0, 5.0), True), ((-12.0, 5.6), True), ((-20.0, 22.0), False), ((-4.0, 5.0), False)],
    ids=["free", "aside", "behind a house", "out of range"],
)
def test_visible_people_in_range_are_reported(at: tuple[float, float], seen: bool) -> None:
    """People are reported in all directions, but not through houses, beyond 15 m, or fully behind
    another person."""
    surface = StreetSurface(tiny_map(), seed=0)
    with rays_on(surface) as rays:
        robot = leaning(surface, np.random.default_rng(0), Pose(-20.0, 5.0, 2.0), 0.0)
        here = [at, (-16.0, 5.0)]
        people = People.of(("one", "near"), here, [0.0] * 2, [0.0] * 2, ("stand",) * 2)
        alone = Street(0, people.only(np.array([0])))
        assert rays.seen_people(robot, alone, 0.62, 15.0).tolist() == [0] * seen
        both = rays.seen_people(robot, Street(0, people), 0.62, 15.0).tolist()
        assert both == [0] * (seen and at[1] > 5.0) + [1]


def test_no_reported_person_is_fully_occluded_in_pictures() -> None:
    """In 15 frames of a drive through a crowd every reported person in the picture from the same
    eye has pixels."""
    scenario = small_scenario()
    scenario = msgspec.structs.replace(
        scenario, crowd=CrowdSpec(persons=40, radius_m=25.0, vehicles=0), events=()
    )
    shown = np.concatenate([one.shown for one in reports(scenario, 15)])
    assert len(shown) > 10 and shown.all()
