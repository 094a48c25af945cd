"""A surface made from meshes: a slope drawn by hand, a street that `cosim export` wrote, a scanned
place."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final, Self

import numpy as np
import shapely
import trimesh
from numpy.typing import ArrayLike

from cosim.core.errors import SpecError
from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from physics.ground.materials import PAVINGS, PLAIN_FRICTION, friction
from physics.ground.mesh import EMPTY, Mesh
from physics.ground.tiles import SURFACES, Key, kind_of, square, surface
from physics.street.surface import Chunk, Patch, Surface
from physics.textures.ground import layer_of
from physics.textures.layers import Colour, encoded

Z_UP: Final = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From glTF's axes (y up) to ours (z up)."""
_GREY: Final = (0.6, 0.6, 0.6)
_STEEPEST: Final = 0.1
"""Nobody stands on triangles whose unit normals rise less."""


class MeshSurface(Surface):
    """Meshes by name, z up, in metres; each is of one material, which its name tells.

    "sidewalk:brick:2", "road", "verge" are kinds of ground with label, friction and colour as on a
    street (physics.ground.tiles); "building:brick" and other labels stand on the ground: solid, but
    nobody stands on them; any other name is open ground. A mesh's own colour goes before that of
    its kind.
    """

    def __init__(self, meshes: Mapping[str, trimesh.Trimesh], seed: int = 0) -> None:
        self.seed = seed
        self._patches = {name: _patch(name, mesh, seed) for name, mesh in meshes.items()}
        self._meshes = meshes
        carrying = [mesh for name, mesh in meshes.items() if self._patches[name].label in _CARRIES]
        corners = np.concatenate([mesh.triangles for mesh in carrying] or [np.zeros((0, 3, 3))])
        normals = np.concatenate([mesh.face_normals for mesh in carrying] or [np.zeros((0, 3))])
        flat = normals[:, 2] > _STEEPEST
        corners, normals = corners[flat], normals[flat]
        self._planes = np.column_stack(
            [-normals[:, :2] / normals[:, 2:], (normals * corners[:, 0]).sum(1) / normals[:, 2]]
        )
        self._plan = shapely.STRtree(np.asarray(shapely.polygons(corners[:, :, :2]), dtype=object))
        plans = {name: mesh.triangles[:, :, :2] for name, mesh in meshes.items()}
        self._reach = {name: (plan.min(axis=1), plan.max(axis=1)) for name, plan in plans.items()}
        self._lowest_m = min(float(mesh.bounds[0, 2]) for mesh in meshes.values())

    @classmethod
    def load(cls, path: Path, seed: int = 0) -> Self:
        """A file that trimesh reads; of glTF (.glb, .gltf) y is up, of all others z. Raises
        SpecError naming it."""
        scene = _read(path)
        if path.suffix.lower() in (".glb", ".gltf"):
            scene.apply_transform(Z_UP)
        placed = {node: scene.graph[node] for node in scene.graph.nodes_geometry}
        shapes = {
            node: scene.geometry[name].copy().apply_transform(at)
            for node, (at, name) in placed.items()
        }
        return cls(
            {node: shape for node, shape in shapes.items() if isinstance(shape, trimesh.Trimesh)},
            seed,
        )

    def heights(self, xy: ArrayLike) -> Floats:
        """Of the highest triangle that carries; where there is none, of the lowest point of all."""
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        point, triangle = self._plan.query(shapely.points(xy), predicate="intersects")
        found = np.full(len(xy), -np.inf)
        np.maximum.at(
            found,
            point,
            (self._planes[triangle] * np.column_stack([xy[point], np.ones(len(point))])).sum(1),
        )
        return np.where(np.isfinite(found), found, self._lowest_m)

    def chunk(self, key: Key) -> Chunk:
        x0, y0, x1, y1 = square(key)
        origins = [(x0, y0, 0.0), (x0, y0, 0.0), (x1, y1, 0.0), (x1, y1, 0.0)]
        inwards = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)]
        ground = []
        for name, mesh in self._meshes.items():
            low, high = self._reach[name]
            near = ((low < (x1, y1)) & (high > (x0, y0))).all(axis=1)
            if near.any():
                here = trimesh.Trimesh(mesh.vertices, mesh.faces[near], process=False).slice_plane(
                    origins, inwards
                )
                if len(here.faces):
                    ground.append(self._patches[name]._replace(mesh=as_mesh(here)))
        return Chunk(tuple(ground))


_CARRIES: Final = {label for label, _ in SURFACES.values()}


def read_mesh(path: Path) -> trimesh.Trimesh:
    """All triangles of a file that trimesh reads, its axes as they are. Raises SpecError naming
    it."""
    mesh: trimesh.Trimesh = _read(path).to_mesh()
    return mesh


def _read(path: Path) -> trimesh.Scene:
    try:
        scene = trimesh.load_scene(path)
    except (OSError, ValueError, KeyError, TypeError, IndexError, NotImplementedError) as error:
        raise SpecError(f"{path}: cannot be read as a mesh: {error}") from error
    if not any(len(getattr(shape, "faces", ())) for shape in scene.geometry.values()):
        raise SpecError(f"{path}: there is no triangle in it")
    return scene


def as_mesh(mesh: trimesh.Trimesh) -> Mesh:
    """The triangles of a mesh, each flat."""
    corners = mesh.triangles.reshape(-1, 3)
    return Mesh(
        corners,
        np.repeat(mesh.face_normals, 3, axis=0),
        np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
    )


def _patch(name: str, mesh: trimesh.Trimesh, seed: int) -> Patch:
    """What a mesh is made of, by its name; its triangles are left out."""
    kind, own = kind_of(name), _colour_of(mesh)
    if kind in SURFACES:
        label, colour = surface(name)
        known = name in PAVINGS or name in SURFACES
        rubs = friction(name if known else kind)
        tinted = own is not None or name in PAVINGS
        return Patch(name, EMPTY, rubs, label, own or colour, layer_of(name, seed), tinted)
    return Patch(
        name, EMPTY, PLAIN_FRICTION, kind if kind in LABELS else "ground", own or _GREY, "plain"
    )


def _colour_of(mesh: trimesh.Trimesh) -> Colour | None:
    """The colour of a mesh's material, sRGB from 0 to 1; None where it has none."""
    material = getattr(mesh.visual, "material", None)
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        return None
    red, green, blue = encoded(np.asarray(factor[:3]) / 255.0).tolist()
    return red, green, blue
