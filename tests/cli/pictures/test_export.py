"""`cosim export`: a scenario's street as glTF, read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from cosim.core.geometry import Pose
from cosim.core.state import RobotState
from cosim.place.walk_graph import WalkGraph
from cosim.results.log import Log
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Barrier, City, Scenario, Suite, write_suite
from physics.cameras.gl.robot_body import parts_in_place
from physics.ground.materials import APPEARANCE_OVERRIDES, PAVINGS
from physics.ground.tiles import SURFACES, ground_kind, tile_bounds, tiles_touching
from physics.street.gltf import as_gltf
from physics.street.street_surface import StreetSurface
from physics.textures.layers import linear_to_srgb, srgb_to_linear
from tests.conftest import Cosim
from tests.support.event_ways import event_way
from tests.support.tiny_street import tiny_map

FENCE = Barrier(x_m=-3.0, y_m=5.0, heading_rad=0.0, length_m=3.0, strip="nw", end=1)
KEYS = tiles_touching(shapely.box(-40.0, -6.0, 40.0, 6.0))
GROUPS = {"surfaces", "buildings", "trees", "furniture", "signals", "barriers"}


@pytest.fixture(scope="module")
def street() -> StreetSurface:
    return StreetSurface(tiny_map(), 3)


@pytest.fixture(scope="module")
def file(street: StreetSurface, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gltf") / "street.glb"
    path.write_bytes(as_gltf(street, KEYS, [FENCE]))
    return path


def test_an_exported_street_equals_its_source(street: StreetSurface, file: Path) -> None:
    """With y up, every triangle of the ground has its place and colour, and nodes are named by what
    they are."""
    import trimesh

    scene = trimesh.load_scene(file)
    x0, y0, x1, y1 = np.array([tile_bounds(key) for key in KEYS]).T
    ground = [patch for key in KEYS for patch in street.chunk(key).ground]
    names = {patch.name for patch in ground}
    assert len(KEYS) == 4 and {ground_kind(name) for name in names} == set(SURFACES)
    for name in names:
        mesh = scene.geometry[scene.graph[name][1]]
        at = scene.graph[name][0]
        found = trimesh.transform_points(mesh.vertices, at)
        assert (found.min(axis=0) >= (x0.min() - 1e-3, -0.01, -y1.max() - 1e-3)).all()
        assert (found.max(axis=0) <= (x1.max() + 1e-3, 0.13, -y0.min() + 1e-3)).all()
        own = [patch.mesh for patch in ground if patch.name == name]
        assert len(mesh.faces) == sum(map(len, own))
        assert mesh.area == pytest.approx(
            sum(trimesh.Trimesh(m.vertices, m.triangles).area for m in own), rel=1e-4
        )
        if name in PAVINGS:
            shown = np.array(mesh.visual.material.baseColorFactor[:3]) / 255.0
            assert shown == pytest.approx(
                srgb_to_linear(APPEARANCE_OVERRIDES.get(name, (name, PAVINGS[name]))[1]), abs=0.003
            )
    fence = scene.geometry["barrier:red"]
    assert fence.bounds[:, 1] == pytest.approx([0.57, 1.12], abs=0.02)
    assert fence.bounds.mean(axis=0)[[0, 2]] == pytest.approx([FENCE.x_m, -FENCE.y_m], abs=0.1)
    red, green, _ = linear_to_srgb(np.array(fence.visual.material.baseColorFactor[:3]) / 255.0)
    assert red > 0.7 and green < 0.2


def test_nodes_are_grouped_by_kind(street: StreetSurface, file: Path) -> None:
    """The root has six groups, which hold every kind of prop in the street, walls, windows and
    fences."""
    import trimesh

    scene = trimesh.load_scene(file)
    parents = scene.graph.transforms.parents
    of_group: dict[str, set[str]] = {}
    for node in scene.graph.nodes_geometry:
        of_group.setdefault(parents[node], set()).add(node.partition("/")[0])
    assert set(of_group) == {"surfaces", "buildings", "furniture", "barriers"}
    assert {parents[group] for group in GROUPS} == {scene.graph.base_frame}
    standing = {prop.kind for key in KEYS for prop, _ in street.chunk(key).props}
    assert of_group["furniture"] == {f"prop:{kind}" for kind in standing} and len(standing) > 4
    assert of_group["buildings"] == {"building:walls", "building:windows"}
    assert of_group["barriers"] == {"barrier:red", "barrier:white", "barrier:posts"}


def ground_of(path: Path) -> np.ndarray:  # type: ignore[type-arg]
    """Return the (N, 3) centres of the level ground triangles in a file, with z up."""
    import trimesh

    scene = trimesh.load_scene(path)
    found = []
    for node in scene.graph.nodes_geometry:
        at, name = scene.graph[node]
        if ground_kind(node) in SURFACES:
            mesh = scene.geometry[name].copy().apply_transform(at)
            found.append(mesh.triangles_center[mesh.face_normals[:, 1] > 0.9])
    x, up, back = np.concatenate(found).T
    return np.column_stack([x, -back, up])


@pytest.mark.engine
def test_the_command_writes_the_tiles_along_a_route(tmp_path: Path, cosim: Cosim) -> None:
    """The export of a scenario of a suite file has trees, and ground along its whole route."""
    import trimesh

    from scenarios.places.nets import place
    from scenarios.suites.long_horizon import build_long_horizon

    city = City(seed=1, size_m=500.0)
    street_map = place(city)[1]
    scenario: Scenario = build_long_horizon(city, street_map, WalkGraph(street_map), 0, "t-0")
    write_suite(Suite(name="tiny", version="1", scenarios=(scenario,)), tmp_path / "tiny.json")
    result = cosim("export", "t-0", "street.glb", "--suite", "tiny.json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "building tiles ..." in result.stderr and result.stdout.startswith(
        "Street: street.glb (t-0, "
    )
    ground = ground_of(tmp_path / "street.glb")
    route = np.array(scenario.route)
    away = np.abs(ground[:, 2] - StreetSurface(street_map, 1).heights(ground[:, :2]))
    assert np.quantile(away, 0.97) < 0.01
    assert max(np.hypot(*(ground[:, :2] - at).T).min() for at in route) < 15.0
    parents = trimesh.load_scene(tmp_path / "street.glb").graph.transforms.parents
    assert {parents[name] for name in ("prop:tree", "prop:tree/1")} == {"trees"} and len(
        scenario.route
    ) > 50
    assert robot_of(tmp_path / "street.glb").mean(axis=0)[:2] == pytest.approx(route[0], abs=0.3)


def robot_of(path: Path) -> np.ndarray:  # type: ignore[type-arg]
    """Return the (N, 3) vertices of the robot in a file, with z up."""
    import trimesh

    scene = trimesh.load_scene(path)
    parents = scene.graph.transforms.parents
    found = [
        trimesh.transform_points(scene.geometry[name].vertices, at)
        for node in scene.graph.nodes_geometry
        for at, name in [scene.graph[node]]
        if parents[node] == "robot"
    ]
    x, up, back = np.concatenate(found).T
    return np.column_stack([x, -back, up])


@pytest.mark.engine
def test_the_robot_of_a_run_is_exported_with_its_legs(
    street: StreetSurface, tmp_path: Path, cosim: Cosim
) -> None:
    """The robot is at its recorded place, on its feet, which are not in their rest position."""
    way = event_way("gesturing", "way", at_m=15.0, time_s=4.5)
    write_suite(Suite(name="one", version="1", scenarios=(way,)), tmp_path / "one.json")
    words = ("one.json", "--policy", "straight", "--robot", "dog")
    assert cosim("run", *words, "--out", "dog", cwd=tmp_path).returncode == 0
    result = cosim("export", "way", "dog.glb", "--run", "dog", "--at", "4", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    body = robot_of(tmp_path / "dog.glb")
    log = Log.load(tmp_path / "dog" / "episodes" / "way" / "trajectory.npz")
    assert body.mean(axis=0)[:2] == pytest.approx(log.pose[79, :2], abs=0.1)
    recorded = parts_in_place(street, robot_called("dog"), log.robot(79))
    assert body.min(axis=0)[2] == pytest.approx(
        min(part.mesh.vertices[:, 2].min() for part in recorded), abs=1e-3
    )
    stood = parts_in_place(street, robot_called("dog"), RobotState(Pose(0.0, 0.0, 0.0)))
    lifted = [
        one.mesh.vertices[:, 2].min() - other.mesh.vertices[:, 2].min()
        for one, other in zip(recorded, stood, strict=True)
    ]
    assert np.ptp(lifted) > 0.03
    late = cosim("export", "way", "late.glb", "--run", "dog", "--at", "999", cwd=tmp_path)
    assert late.returncode == 2 and "'way' ended after" in late.stderr


def test_invalid_export_requests_are_refused_before_the_build(tmp_path: Path, cosim: Cosim) -> None:
    """An unknown scenario, a wrong file ending and a missing folder are reported with the valid
    choices."""
    requests = {
        ("lh-011-0", "a.glb"): (2, "among them lh-011-00, "),
        ("lh-011-00", "a.obj"): (
            2,
            "a.obj: cannot be written as glTF; use a name that ends in .glb",
        ),
        ("lh-011-00", "no/a.glb"): (3, "no/a.glb: cannot be written: no folder no"),
    }
    requests |= {
        ("lh-011-00", "a.glb", "--at", "3"): (2, "--at needs --run RUN"),
        ("lh-011-00", "a.glb", "--run", "no"): (2, "no"),
    }
    for words, (code, message) in requests.items():
        result = cosim("export", *words, cwd=tmp_path)
        assert (result.returncode, result.stdout) == (code, "") and message in result.stderr, result
    assert not list(tmp_path.iterdir())
