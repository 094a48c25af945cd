"""Surface of a scanned place: ground from the height grid, everything else from the mesh.

Near drawn areas the ground has the lattice of the height grid, elsewhere one of `_BLOCK_M`. What
rises from it is one concave body per tile. The scan's mesh is drawn, and where it has a hole in an
area, the ground.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import MultiPolygon, Polygon

from cosim.core.cache import ArrayCache, Arrays
from cosim.core.geometry import Floats
from cosim.core.state import LABELS
from cosim.place import overlay
from cosim.place.scan import AreaKind, Scan, ScanMesh
from cosim.place.street_map import StreetMap
from cosim.place.terrain import Terrain
from physics.ground.materials import friction
from physics.ground.mesh import Ints, Mesh, smooth_normals
from physics.ground.tiles import Key, surface_look, tile_bounds, tile_indices
from physics.street.surface import Chunk, Patch, PlaceSurface, ScannedPatch
from physics.street.tile_cache import SOURCES_KEY
from physics.textures.ground import layer_of
from physics.textures.layers import Colour

STANDING_M: Final = 0.15
"""Height above the ground in metres from which a triangle is an obstacle."""
_OVERHEAD_M: Final = 3.0
"""Height above the ground in metres of the lowest point of triangles without a body."""
_FINE_M: Final = 4.0
"""Distance in metres from an area within which the ground has the lattice of the height grid."""
_BLOCK_M: Final = 1.0
"""Side of a square of the ground elsewhere in metres."""
_LEVELS: Final = 24
"""Levels of brightness for cameras with one colour per body."""

_KINDS: Final[tuple[AreaKind, ...]] = ("crossing", "sidewalk", "road", "verge")
"""Kinds of areas with their own ground; where areas overlap, the first one counts."""
_GROUND: Final = "ground"
_SURFACE_LABELS: Final = {kind: surface_look(kind)[0] for kind in (*_KINDS, _GROUND)}


class ScanSurface(PlaceSurface):
    """Surface of a scanned place.

    scan: with or without its splats.
    """

    scan: Scan

    def __init__(self, street_map: StreetMap, scan: Scan, seed: int) -> None:
        self.street_map = street_map
        self.scan = scan
        self.seed = seed
        grid = scan.heights
        x0, y0 = map(float, grid.origin)
        self._terrain = Terrain(x0, y0, grid.step_m, grid.heights)
        facts = scan.facts
        text = f"{facts.mesh_hash} {facts.areas_hash} {seed} {SOURCES_KEY}"
        self._cache = ArrayCache("tiles", hashlib.sha256(text.encode()).hexdigest()[:32])

    def heights(self, xy: ArrayLike) -> Floats:
        return self._terrain.height(xy)

    def kept(self, kind: str, key: Key, make: Callable[[], Arrays]) -> Arrays:
        return self._cache.get(f"{kind}_{key[0]}_{key[1]}", make)

    def chunk(self, key: Key) -> Chunk:
        arrays = self.kept("scan", key, lambda: self._built(key))
        ground = [
            Patch(
                kind,
                self._mesh(arrays, f"ground-{kind}"),
                friction(kind),
                *surface_look(kind),
                layer_of(kind, self.seed),
            )
            for kind in _SURFACE_LABELS
            if f"ground-{kind}-triangles" in arrays
        ]
        standing = self._mesh(arrays, "standing")
        return Chunk(tuple(ground), standing=(standing,) if len(standing) else ())

    def scanned(self, key: Key) -> tuple[ScannedPatch, ...]:
        arrays = self.kept("scanned", key, lambda: self._drawn(key))
        return tuple(
            ScannedPatch(self._mesh(arrays, label), arrays[f"{label}-colours"] / 255.0, label)
            for label in LABELS
            if f"{label}-triangles" in arrays
        )

    def _mesh(self, arrays: Arrays, name: str) -> Mesh:
        vertices, triangles = arrays[f"{name}-vertices"], arrays[f"{name}-triangles"]
        return Mesh(vertices, smooth_normals(vertices, triangles), triangles)

    def _built(self, key: Key) -> Arrays:
        """Build ground and obstacles of a tile."""
        found: dict[str, NDArray[Any]] = {}
        cells = self._cells_of(key)
        kinds = self._kinds_at(cells.middles)
        for number, kind in enumerate((*_KINDS, _GROUND)):
            here = kinds == number
            if here.any():
                found |= _named(f"ground-{kind}", *self._lattice(cells.corners[here]))
        mesh = self.scan.mesh
        rows = self._triangles_of.get(key, np.zeros(0, dtype=np.intp))
        low, high = self._above_ground(mesh, rows)
        rows = rows[(high > STANDING_M) & (low < _OVERHEAD_M)]
        return found | _named("standing", *_picked(mesh.vertices, mesh.triangles[rows])[:2])

    def _drawn(self, key: Key) -> Arrays:
        """Build the drawn triangles of a tile, by label."""
        mesh = self.scan.mesh
        rows = self._triangles_of.get(key, np.zeros(0, dtype=np.intp))
        labels = self._labels_of(mesh, rows)
        holes = self._holes(key)
        found: dict[str, NDArray[Any]] = {}
        for label, number in LABELS.items():
            here = rows[labels == number]
            parts = []
            if len(here):
                vertices, triangles, used = _picked(mesh.vertices, mesh.triangles[here])
                parts.append((vertices, triangles, mesh.colours[used]))
            if label in holes:
                ground = mesh.triangles[rows[labels != LABELS["building"]]]
                parts.append(self._patched(holes[label], mesh.colours[ground.ravel()]))
            if parts:
                starts = np.cumsum([0, *(len(part[0]) for part in parts)])
                triangles = np.concatenate(
                    [part[1] + start for part, start in zip(parts, starts, strict=False)]
                ).astype(np.int32)
                found |= _named(label, np.concatenate([part[0] for part in parts]), triangles)
                found[f"{label}-colours"] = np.concatenate([part[2] for part in parts])
        return found

    def _holes(self, key: Key) -> dict[str, Ints]:
        """Return the squares of areas in a tile where the scan has no ground, by label."""
        cells = self._cells_of(key)
        kinds = self._kinds_at(cells.middles)
        measured = self.scan.heights.measured[cells.corners[:, 0, 1], cells.corners[:, 0, 0]]
        names = np.array([_SURFACE_LABELS[kind] for kind in (*_KINDS, _GROUND)])
        hole = ~measured & (kinds < len(_KINDS))
        corners, of_label = cells.corners[hole], names[kinds[hole]]
        return {label: corners[of_label == label] for label in np.unique(of_label).tolist()}

    def _patched(
        self, squares: Ints, colours: NDArray[np.uint8]
    ) -> tuple[Floats, Ints, NDArray[np.uint8]]:
        """Return the ground of squares in the mean of (N, 3) colours."""
        vertices, triangles = self._lattice(squares)
        look = np.array(surface_look("sidewalk")[1])
        colour = colours.mean(axis=0) if len(colours) else 255.0 * look
        return vertices, triangles, np.tile(np.rint(colour).astype(np.uint8), (len(vertices), 1))

    def _labels_of(self, mesh: ScanMesh, rows: NDArray[np.intp]) -> NDArray[np.uint8]:
        """Return the label of each triangle: its own, or by area and height."""
        _, high = self._above_ground(mesh, rows)
        middles = _middles(mesh, rows)
        kinds = self._kinds_at(middles[:, :2])
        of_kind = np.array([LABELS[_SURFACE_LABELS[kind]] for kind in (*_KINDS, _GROUND)])
        guessed = np.where(high > STANDING_M, LABELS["building"], of_kind[kinds])
        own = mesh.labels[rows]
        return np.where(own > 0, own, guessed).astype(np.uint8)

    def _above_ground(self, mesh: ScanMesh, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return the heights above the ground of the lowest and highest corner of triangles."""
        corners = mesh.vertices[mesh.triangles[rows]].astype(float)
        above = corners[..., 2] - self.heights(corners[..., :2].reshape(-1, 2)).reshape(-1, 3)
        a, b, c = above.T
        return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)

    def _kinds_at(self, xy: Floats) -> NDArray[np.intp]:
        """Return the number in `_KINDS` of the area at (N, 2) points, `len(_KINDS)` without one."""
        kinds = np.full(len(xy), len(_KINDS))
        for number in reversed(range(len(_KINDS))):
            area = self._areas[number]
            if not area.is_empty:
                kinds[shapely.contains_xy(area, xy[:, 0], xy[:, 1])] = number
        return kinds

    @cached_property
    def _areas(self) -> Sequence[Polygon | MultiPolygon]:
        """Union of the areas of each of `_KINDS`."""
        unions = [
            overlay.union_all([area.polygon for area in self.scan.areas if area.kind == kind])
            for kind in _KINDS
        ]
        shapely.prepare(unions)
        return unions

    @cached_property
    def _near_areas(self) -> shapely.Geometry:
        """Ground near areas, where the lattice is fine."""
        near = shapely.buffer(overlay.union_all(self._areas), _FINE_M)
        shapely.prepare(near)
        return near

    @cached_property
    def _triangles_of(self) -> dict[Key, NDArray[np.intp]]:
        """Triangles of the mesh by the tile of their middle."""
        mesh = self.scan.mesh
        keys = tile_indices(_middles(mesh, np.arange(len(mesh.triangles)))[:, :2])
        order = np.lexsort(keys.T)
        cuts = np.flatnonzero((np.diff(keys[order], axis=0) != 0).any(axis=1)) + 1
        return {
            (int(keys[part[0], 0]), int(keys[part[0], 1])): np.sort(part)
            for part in np.split(order, cuts)
            if len(part)
        }

    def _cells_of(self, key: Key) -> _Cells:
        """Return the squares of the ground whose middle lies in a tile."""
        grid = self.scan.heights
        rows, columns = grid.heights.shape
        wide = max(round(_BLOCK_M / grid.step_m), 1)
        corners = self._squares(key, wide, rows - 1, columns - 1)
        return _Cells(corners, grid.origin + grid.step_m * 0.5 * corners.sum(axis=1))

    def _squares(self, key: Key, wide: int, rows: int, columns: int) -> Ints:
        """Return (N, 2, 2) columns and rows of the first and last corner of squares."""
        grid = self.scan.heights
        x0, y0, x1, y1 = tile_bounds(key)
        (i0, j0), (i1, j1) = (
            np.floor((np.array(at) - grid.origin) / grid.step_m / wide).astype(int)
            for at in ((x0, y0), (x1, y1))
        )
        i, j = np.meshgrid(
            np.arange(max(i0, 0), min(i1 + 1, -(-columns // wide))),
            np.arange(max(j0, 0), min(j1 + 1, -(-rows // wide))),
        )
        first = wide * np.stack([i.ravel(), j.ravel()], axis=1)
        squares = np.stack([first, np.minimum(first + wide, (columns, rows))], axis=1)
        middles = grid.origin + grid.step_m * 0.5 * squares.sum(axis=1)
        squares = squares[(tile_indices(middles) == key).all(axis=1)]
        middles = grid.origin + grid.step_m * 0.5 * squares.sum(axis=1)
        whole = (squares[:, 1] - squares[:, 0] == wide).all(axis=1)
        fine = shapely.contains_xy(self._near_areas, middles[:, 0], middles[:, 1]) | ~whole
        return np.concatenate([squares[~fine], _divided(squares[fine])]).astype(np.int32)

    def _lattice(self, squares: Ints) -> tuple[Floats, Ints]:
        """Return vertices and triangles of squares, divided as in `Terrain`."""
        (i0, j0), (i1, j1) = squares[:, 0].T, squares[:, 1].T
        columns = self.scan.heights.heights.shape[1]
        corners = np.stack(
            [j0 * columns + i0, j0 * columns + i1, j1 * columns + i1, j1 * columns + i0], axis=1
        )
        nodes, of_node = np.unique(corners, return_inverse=True)
        of_node = of_node.reshape(-1, 4).astype(np.int32)
        grid = self.scan.heights
        row, column = np.divmod(nodes, columns)
        xy = grid.origin + grid.step_m * np.stack([column, row], axis=1)
        z = grid.heights[row, column].astype(float)
        triangles = np.concatenate([of_node[:, [0, 1, 2]], of_node[:, [0, 2, 3]]])
        return np.column_stack([xy, z]), triangles


class _Cells(NamedTuple):
    """Squares of the ground.

    corners: (N, 2, 2) column and row of the first and of the last corner in the height grid.
    middles: (N, 2) metres.
    """

    corners: Ints
    middles: Floats


def posterized(patches: Sequence[ScannedPatch]) -> list[tuple[Mesh, Colour, str]]:
    """Return scanned triangles as meshes of one colour, with their labels, for renderers without
    colours of vertices."""
    found = []
    for mesh, colours, label in patches:
        colour = colours[mesh.triangles].mean(axis=1)
        level = np.rint(colour.mean(axis=1) * (_LEVELS - 1)).astype(int)
        for shade in np.unique(level):
            rows = level == shade
            vertices, triangles, used = _picked(mesh.vertices, mesh.triangles[rows])
            red, green, blue = colour[rows].mean(axis=0).tolist()
            part = Mesh(vertices, mesh.normals[used], triangles)
            found.append((part, (red, green, blue), label))
    return found


def _divided(squares: Ints) -> Ints:
    """Return (N, 2, 2) corners of the cells of the height grid in squares, by square and row."""
    first, size = squares[:, 0], squares[:, 1] - squares[:, 0]
    counts = size.prod(axis=1)
    owner = np.repeat(np.arange(len(squares)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    row, column = np.divmod(number, size[owner, 0])
    cell = first[owner] + np.stack([column, row], axis=1)
    return np.stack([cell, cell + 1], axis=1)


def _middles(mesh: ScanMesh, rows: NDArray[np.intp]) -> Floats:
    corners = mesh.vertices[mesh.triangles[rows]].astype(float)
    return np.asarray((corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0)


def _picked(vertices: NDArray[np.floating], triangles: Ints) -> tuple[Floats, Ints, Ints]:
    """Return the used vertices, the triangles among them, and the numbers of these vertices."""
    used, places = np.unique(triangles, return_inverse=True)
    return vertices[used].astype(float), places.reshape(-1, 3).astype(np.int32), used


def _named(name: str, vertices: Floats, triangles: Ints) -> dict[str, NDArray[Any]]:
    return {f"{name}-vertices": vertices, f"{name}-triangles": triangles}
