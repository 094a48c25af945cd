"""Export of a street surface as glTF (y up, metres), with a node per kind and colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from cosim.core.progress import Progress, ignore
from cosim.spec.obstacle import Obstacle
from cosim.spec.scenario import Barrier
from physics.ground.mesh import Mesh, Part, join
from physics.ground.tiles import Key
from physics.street import props
from physics.street.buildings import FACADES, WINDOW_COLOUR, facade_meshes
from physics.street.furniture import KINDS, Prop, parts_of
from physics.street.scan_surface import posterized
from physics.street.surface import Patch, Surface, grounded_obstacles
from physics.textures.ground import ground_layers
from physics.textures.layers import Colour, linear_to_srgb, srgb_to_linear

_GROUPS: Final = (
    *("surfaces", "buildings", "trees", "furniture", "signals", "barriers", "obstacles", "robot"),
)
"""Nodes below the root; their children have names such as "sidewalk:brick:2"."""
_LAYERS_PX: Final = 256
"""Size in pixels of the texture layers whose mean colours are used."""


def as_gltf(
    surface: Surface,
    keys: Sequence[Key],
    barriers: Sequence[Barrier] = (),
    progress: Progress = ignore,
    obstacles: Sequence[Obstacle] = (),
    robot: Sequence[Part] = (),
) -> bytes:
    """Return a .glb file of tiles of a surface with barriers, obstacles and a robot.

    robot: parts in the map's frame, each with a colour.
    """
    parts = _Parts()
    for n, key in enumerate(keys):
        progress("building tiles", n / len(keys))
        parts.add_square(surface, key)
    for barrier in barriers:
        size = (barrier.thickness_m, barrier.length_m)
        at = (
            barrier.x_m,
            barrier.y_m,
            surface.foot(barrier.x_m, barrier.y_m, barrier.heading_rad, size),
        )
        names = ("red", "white", "posts")
        for name, part in zip(names, props.barrier_parts(barrier), strict=True):
            mesh = part.mesh.moved(at, barrier.heading_rad)
            parts.add("barriers", f"barrier:{name}", mesh, part.colour or props.PROP_RED)
    for prop, z in grounded_obstacles(obstacles, surface):
        parts.add_prop("obstacles", prop, z)
    for part in robot:
        assert part.colour is not None
        parts.add("robot", "robot:body", part.mesh, part.colour)
    progress("writing")
    written: bytes = parts.scene().export(file_type="glb", include_normals=True)
    return written


class _Parts:
    """Meshes collected by group, name and colour."""

    def __init__(self) -> None:
        self._meshes: dict[tuple[str, str, Colour], list[Mesh]] = {}
        layers = ground_layers(_LAYERS_PX)
        self._layer_means: dict[str, Colour] = dict(
            zip(layers.names, map(tuple, linear_to_srgb(layers.mean).tolist()), strict=True)
        )

    def add(self, group: str, name: str, mesh: Mesh, colour: Colour) -> None:
        if len(mesh):
            self._meshes.setdefault((group, name, colour), []).append(mesh)

    def add_square(self, surface: Surface, key: Key) -> None:
        chunk, finish = surface.chunk(key), surface.finish(key)
        scanned = posterized(surface.scanned(key))
        for mesh, colour, label in scanned:
            self.add("surfaces", label, mesh, colour)
        ground = (*chunk.ground, *finish.laid, *finish.painted) if surface.scan is None else ()
        for patch in ground:
            self.add("surfaces", patch.name, patch.mesh, self._mean_colour(patch))
        for facade, mesh in facade_meshes(chunk.buildings).items():
            name, colour = ("windows", WINDOW_COLOUR) if facade < 0 else ("walls", FACADES[facade])
            self.add("buildings", f"building:{name}", mesh, colour)
        for prop, z in chunk.props:
            self.add_prop("trees" if prop.kind == "tree" else "furniture", prop, z)
        posts = surface.posts(key)
        for post, z in zip(
            posts, surface.heights([(post.x_m, post.y_m) for post in posts]).tolist(), strict=True
        ):
            self.add(
                "signals",
                "signal:post",
                props.post_mesh().moved((post.x_m, post.y_m, z), post.heading_rad),
                props.POLE,
            )

    def add_prop(self, group: str, prop: Prop, z_m: float) -> None:
        name = prop.kind if group == "obstacles" else f"prop:{prop.kind}"
        for part in parts_of(*prop.form):
            mesh = part.mesh.moved((prop.x_m, prop.y_m, z_m), prop.drawn_heading_rad)
            self.add(group, name, mesh, part.colour or KINDS[prop.kind].paints[prop.paint])

    def _mean_colour(self, patch: Patch) -> Colour:
        """Return the mean colour that cameras with textures show."""
        return patch.colour if patch.tinted else self._layer_means[patch.layer]

    def scene(self) -> trimesh.Scene:
        """Return a scene with one node per kind and colour below the nodes of _GROUPS."""
        scene = trimesh.Scene()
        node_counts = {(group, name): 0 for group, name, _ in self._meshes}
        for group in _GROUPS:
            scene.graph.update(frame_from=scene.graph.base_frame, frame_to=group)
        for (group, name, colour), meshes in self._meshes.items():
            number = node_counts[group, name]
            node_counts[group, name] += 1
            node = f"{name}/{number}" if number else name
            scene.add_geometry(
                _geometry(join(meshes), node, colour), node, node, parent_node_name=group
            )
        return scene


def _geometry(mesh: Mesh, name: str, colour: Colour) -> trimesh.Trimesh:
    """Convert a mesh to a glTF geometry with y up."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    factor = np.append(srgb_to_linear(colour), 1.0)
    material = PBRMaterial(
        name=name, baseColorFactor=factor, metallicFactor=0.0, roughnessFactor=1.0
    )
    return trimesh.Trimesh(
        mesh.vertices @ turn,
        mesh.triangles,
        vertex_normals=mesh.normals @ turn,
        visual=TextureVisuals(material=material),
        process=False,
    )
