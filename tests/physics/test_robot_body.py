"""The drawn body of a robot: shapes of its URDF and mesh files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import SpecError
from cosim.spec.robot import COURIER
from physics.cameras.gl.robot_body import link_parts, robot_parts
from physics.robots import urdf_path

CHASSIS = re.compile(r'<box size="([\d. ]+)"\s*/>')


def with_visual(folder: Path, shape: str) -> Path:
    """Write the courier's URDF with another shape in place of its first box."""
    text = urdf_path(COURIER).read_text()
    path = folder / "other.urdf"
    path.write_text(CHASSIS.sub(shape, text, count=1))
    return path


@pytest.mark.parametrize("ending", ["obj", "stl", "glb"])
def test_a_body_from_a_file_is_drawn_like_one_of_boxes(tmp_path: Path, ending: str) -> None:
    """A box in a mesh file, scaled by the URDF, has the corners, normals, colour and place of the
    box it replaces."""
    import trimesh

    box = CHASSIS.search(urdf_path(COURIER).read_text())
    assert box is not None
    size = np.array(box[1].split(), dtype=float)
    trimesh.creation.box(10.0 * size).export(tmp_path / f"chassis.{ending}")
    made = robot_parts(
        with_visual(tmp_path, f'<mesh filename="chassis.{ending}" scale="0.1 0.1 0.1"/>')
    )
    plain = robot_parts(urdf_path(COURIER))
    assert [part.colour for part in made] == [part.colour for part in plain]
    for one, other in zip(made, plain, strict=True):
        assert corners(one.mesh) == corners(other.mesh)


def corners(mesh: object) -> set[tuple[float, ...]]:
    """Return positions and normals of the corners of a mesh, to a hundredth of a millimetre."""
    rows = np.column_stack([mesh.vertices, mesh.normals])  # type: ignore[attr-defined]
    return set(map(tuple, (np.rint(1e5 * rows) + 0.0).tolist()))


def test_a_colour_inside_a_visual_is_drawn(tmp_path: Path) -> None:
    """It replaces the colour of its name under `robot`."""
    path, colour = with_visual(tmp_path, r'<box size="\1"/>'), '<color rgba="1 0 0 1"/>'
    text = path.read_text()
    path.write_text(text.replace('name="body"/>', f'name="body">{colour}</material>', 1))
    assert robot_parts(path)[0].colour == (1.0, 0.0, 0.0)
    assert robot_parts(path)[1].colour == robot_parts(urdf_path(COURIER))[1].colour


def test_an_invalid_visual_is_refused(tmp_path: Path) -> None:
    """A missing mesh file and an unsupported shape are named."""
    with pytest.raises(SpecError, match=r"gone\.stl: cannot be read as a mesh"):
        robot_parts(with_visual(tmp_path, '<mesh filename="gone.stl"/>'))
    link_parts.cache_clear()
    with pytest.raises(
        SpecError,
        match=r"a visual is a capsule; valid are box, cylinder, sphere and mesh",
    ):
        robot_parts(with_visual(tmp_path, '<capsule radius="1" length="2"/>'))
