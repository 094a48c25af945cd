"""Weather: hashes, friction, and pictures of the gl camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import SpecError, UsageError
from cosim.core.geometry import Pose
from cosim.core.state import LABELS, Command, Frame, Street
from cosim.place.street_map import StreetMap
from cosim.spec.camera import CameraSpec
from cosim.spec.options import EpisodeOptions
from cosim.spec.scenario import City, CrowdSpec, Light, Scenario, content_hash
from cosim.spec.weather import CLEAR, SNOW_GRIP, WEATHERS, WET_GRIP
from physics.cameras.gl import context
from physics.cameras.gl.camera import GlCamera
from physics.cameras.gl.variants import Variant
from physics.cameras.gl.weather import lit_share, weather_look, weathered_sky
from physics.dynamics.bullet import p
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from scenarios.places.nets import place
from tests.physics.test_gl import moment, same
from tests.support.driven_runs import short_way
from tests.support.tiny_street import tiny_map

needs_gl = pytest.mark.skipif(not context.available(), reason="no OpenGL through EGL here")
SPEC = CameraSpec(width=96, height=64)


def test_clear_weather_is_not_encoded() -> None:
    """A scenario in clear weather has the bytes and the hash of one without the field."""
    plain = short_way("a")
    assert b"weather" not in msgspec.json.encode(plain.in_weather(CLEAR))
    assert content_hash(plain.in_weather("rain").in_weather(CLEAR)) == content_hash(plain)
    rainy = plain.in_weather("rain")
    assert content_hash(rainy) != content_hash(plain)
    read = msgspec.json.decode(msgspec.json.encode(rainy), type=Scenario)
    assert read == rainy and read.conditions is WEATHERS["rain"]


def test_the_documents_have_every_weather() -> None:
    """The table of docs/scenarios.md has the names, factors and rates of the rows."""
    text = (Path(__file__).parents[2] / "docs" / "scenarios.md").read_text()
    rows = [line.strip("| \n").split("|") for line in text.splitlines() if line.startswith("| `")]
    table = {cells[0].strip(" `"): [c.strip() for c in cells[1:]] for cells in rows}
    for name, weather in WEATHERS.items():
        falling, *_, grip, hurry = table[name]
        assert float(falling or 0.0) == weather.rain_mm_h + weather.snow_mm_h, name
        assert (float(grip), float(hurry)) == (weather.grip, weather.hurry), name


def test_invalid_weather_is_refused() -> None:
    """An unknown name lists the valid ones, and weather in a photographed sky is a
    contradiction."""
    with pytest.raises(SpecError, match=r"unknown weather 'rian'\. Valid choices: clear, dusk, .*"):
        short_way("a", weather="rian")
    with pytest.raises(UsageError, match=r"unknown weather 'rian'.*Did you mean rain\?"):
        EpisodeOptions(weather="rian")
    with pytest.raises(SpecError, match=r"weather 'snow' contradicts light\.hdri"):
        short_way("a", weather="snow", light=Light(hdri="sky.hdr"))


def test_weather_keeps_people_indoors() -> None:
    """At night fewer residents and children are outside, and a clear day changes no crowd."""
    one = short_way("a", crowd=CrowdSpec(residents=10, groups=0.6, children=0.2))
    assert one.weathered_crowd is one.crowd
    night = one.in_weather("night").weathered_crowd
    assert night.residents == 1 and night.children == pytest.approx(0.02)


@pytest.mark.engine
def test_rain_and_snow_lengthen_the_braking_distance() -> None:
    """On dry ground the motors limit braking at 4 m/s; with locked wheels, distances on wet ground
    and snow are inverse to the friction."""
    slides_m = []
    for grip in (1.0, WET_GRIP, SNOW_GRIP):
        with BulletWorld(StreetSurface(tiny_map(), seed=1), grip=grip) as world:
            world.place(Pose(-40.0, 100.0, 0.0))
            assert world._bodies is not None
            world.step(Command(0.0, 0.0), Street(0), Street(0), 100)
            client, body = world._bodies._client, world._bodies._robot
            p.resetBaseVelocity(body, (4.0, 0.0, 0.0), physicsClientId=client)
            moved = [
                world.step(Command(0.0, 0.0), Street(0), Street(0), 10).robot.pose.x_m
                for _ in range(60)
            ]
            slides_m.append(moved[-1] + 40.0)
    assert slides_m[1] > 1.2 * slides_m[0]
    assert slides_m[2] / slides_m[1] == pytest.approx(WET_GRIP / SNOW_GRIP, rel=0.03)


@pytest.fixture(scope="module")
def world() -> BulletWorld:
    return BulletWorld(StreetSurface(street_map(), 1))


def street_map() -> StreetMap:
    return place(City(seed=1, size_m=500.0))[1]


@pytest.fixture(scope="module")
def frames(world: BulletWorld) -> Iterator[dict[str, Frame]]:
    """Return the same view in weathers that together use every variant of the programs."""
    found = {}
    robot, street = moment(world, 3)
    for name in (CLEAR, "heavy_rain", "low_sun", "snow", "rainy_night"):
        with GlCamera(world, SPEC, depth=True, weather=WEATHERS[name]) as camera:
            found[name] = camera.render(robot, street)
            assert same(found[name], camera.render(robot, street)), name
    yield found


@needs_gl
@pytest.mark.engine
def test_labels_and_depth_do_not_depend_on_the_weather(frames: dict[str, Frame]) -> None:
    """Drops, snow and darkness change only colours, each weather its own, and in rain people have
    umbrellas."""
    clear = frames[CLEAR]
    assert clear.labels is not None and clear.depth is not None
    for name, frame in frames.items():
        assert frame.labels is not None and frame.depth is not None
        others = (frame.labels != LABELS["person"]) & (clear.labels != LABELS["person"])
        assert others.mean() > 0.9
        assert np.array_equal(frame.labels[others], clear.labels[others]), name
        assert np.array_equal(frame.depth[others], clear.depth[others]), name
    assert len({frame.rgb.tobytes() for frame in frames.values()}) == len(frames)


@needs_gl
@pytest.mark.engine
def test_clear_days_have_no_weather_in_their_pictures(
    world: BulletWorld, frames: dict[str, Frame]
) -> None:
    """Clear, overcast and foggy days use the programs of days, and a clear day has the same
    bits."""
    for name, look in (
        (name, weather_look(weather, weathered_sky(Light(), weather, 1), 1, True))
        for name, weather in WEATHERS.items()
    ):
        assert (look is None) == (name in (CLEAR, "overcast", "fog")), name
    assert Variant(True).defines == "#define SHADOWS\n" and Variant(False).defines == ""
    with GlCamera(world, SPEC, depth=True) as camera:
        assert same(camera.render(*moment(world, 3)), frames[CLEAR])


@needs_gl
@pytest.mark.engine
def test_lamps_light_the_ground_at_night(
    world: BulletWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without its lamps the ground is darker at night, and much darker near a lamp."""
    robot, street = moment(world, 3)
    with GlCamera(world, SPEC, weather=WEATHERS["night"]) as camera:
        lit = camera.render(robot, street)
        scene = camera._stage.scene
        assert len(scene._heads) > 0
        monkeypatch.setattr(scene, "_heads", np.zeros((0, 3)))
        dark = camera.render(robot, street)
    assert lit.labels is not None
    ground = np.isin(lit.labels, [LABELS[name] for name in ("road", "sidewalk", "verge")])
    gain = lit.rgb[ground].mean(axis=1) - dark.rgb[ground].mean(axis=1)
    assert gain.mean() > 5.0 and np.quantile(gain, 0.95) > 25.0


@needs_gl
@pytest.mark.engine
def test_fewer_windows_are_lit_late_at_night(world: BulletWorld) -> None:
    """Pixels of walls are lit at 21:00 and dark at 4:30, and hardly any the other way round."""
    assert lit_share(4.5) < 0.1 < lit_share(23.0) < lit_share(21.0) and lit_share(
        24.0
    ) == lit_share(0)
    walls = []
    for hour in (21.0, 4.5):
        with GlCamera(world, SPEC, light=Light(hour=hour, day_of_year=15)) as camera:
            frame = camera.render(*moment(world, 3))
        assert frame.labels is not None
        walls.append(frame.rgb[frame.labels == LABELS["building"]].astype(int).min(axis=1))
    only_evening, only_morning = (
        int((one - other > 60).sum()) for one, other in (walls, walls[::-1])
    )
    assert only_evening > 50 and only_evening > 10 * only_morning
