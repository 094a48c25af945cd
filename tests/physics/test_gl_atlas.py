"""Many environments in one atlas: the same pictures, read back together."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.errors import EngineError, UsageError
from cosim.episode.ports import CameraSpec
from physics.cameras.gl import context
from physics.world.street_surface import StreetSurface
from physics.world.world import BulletWorld
from scenarios.bench.cameras import busy_street, camera_city

pytestmark = [
    pytest.mark.engine,
    pytest.mark.skipif(not context.available(), reason="no OpenGL through EGL here"),
]

SPEC = CameraSpec(96, 54, fov_deg=60.0)


def test_an_atlas_holds_the_pictures_of_its_cameras() -> None:
    """Three environments drawn at once, with a second picture under way before the first is read: bit for bit what
    three cameras draw one by one."""
    from physics.cameras.gl.atlas import Atlas
    from physics.cameras.gl.camera import GlCamera

    street_map = camera_city(300.0)
    worlds = [BulletWorld(StreetSurface(street_map, seed)) for seed in (1, 2, 3)]
    busy = busy_street(street_map, 8, 5)
    ticks = [[busy.streets[i + k] for k in range(3)] for i in range(2)]
    single = []
    for k, world in enumerate(worlds):
        with GlCamera(world, SPEC) as camera:
            single.append([camera.render(busy.robot, streets[k]) for streets in ticks])
    with Atlas(worlds, SPEC) as atlas:
        for streets in ticks:
            atlas.begin([(busy.robot, street) for street in streets])
        with pytest.raises(EngineError, match="under way"):
            atlas.begin([(busy.robot, street) for street in ticks[0]])
        together = [atlas.end() for _ in ticks]
    for k in range(3):
        for i in range(2):
            assert np.array_equal(together[i][k].rgb, single[k][i].rgb)
            assert np.array_equal(together[i][k].labels, single[k][i].labels)
    assert not np.array_equal(single[0][0].rgb, single[1][0].rgb)


def test_people_alone_are_the_same_with_the_next_picture_under_way() -> None:
    """People, fetched while the next are drawn: bit for bit what is drawn one by one, and they move."""
    from physics.cameras.gl.alone import PeopleAlone

    busy = busy_street(camera_city(300.0), 8, 3)
    with PeopleAlone((96, 54), 60.0) as eyes:
        single = [eyes.render(busy.robot.pose, street) for street in busy.streets]
        found = []
        for street in busy.streets:
            eyes.begin(busy.robot.pose, street)
            if street.tick:
                found.append(eyes.end())
        found.append(eyes.end())
        with pytest.raises(EngineError, match="under way"):
            eyes.end()
    for one, other in zip(single, found, strict=True):
        assert np.array_equal(one.rgb, other.rgb) and np.array_equal(one.labels, other.labels)
    assert not np.array_equal(found[0].rgb, found[2].rgb)


def test_an_atlas_too_large_is_refused_with_the_limit() -> None:
    """More rows than a texture may have."""
    from physics.cameras.gl.atlas import Atlas

    world = BulletWorld(StreetSurface(camera_city(300.0), 1))
    with pytest.raises(UsageError, match="1 to 16 fit"):
        Atlas([world] * 17, CameraSpec(64, 1024))
