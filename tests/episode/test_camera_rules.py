"""The rules for policy cameras, and the messages about cameras that break them."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.errors import SpecError, UsageError
from cosim.core.geometry import Pose
from cosim.core.state import People, RobotState, Street
from cosim.episode.manifest_checks import nonstandard
from cosim.results.run_folder import read_records, read_spec
from cosim.results.table import table_row
from cosim.spec.camera import CameraSpec, Lens
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER, SCOUT, Mount
from cosim.spec.scenario import City, Scenario, Suite
from physics.cameras.choice import camera_of
from physics.cameras.gl import context
from physics.dynamics.world import BulletWorld
from physics.street.street_surface import StreetSurface
from scenarios.episodes.episode import Episode
from scenarios.runs.run import run
from scenarios.tools.verify.doctor import small_scenario
from tests.run_specs import record_of
from tests.support.cheats import FarEye
from tests.support.tiny_street import tiny_map

SHORT = Scenario(
    id="s-0",
    suite="s",
    place=City(seed=0),
    seed=0,
    start=(0.0, 0.0, 0.0),
    goal=(9.0, 0.0),
    route=((0.0, 0.0), (9.0, 0.0)),
)


@pytest.mark.parametrize(
    ("camera", "rate_hz", "expected"),
    [
        (None, 20.0, ""),
        (CameraSpec(), 4.0, ""),
        (
            CameraSpec(1280, 960, 120.0, "mast", crop=(0, 0, 10, 10)),
            20.0,
            "a camera of 120 deg at 'mast'",
        ),
        (CameraSpec(1280, 960, 90.0, "mast"), 20.0, ""),
        (CameraSpec(1281, 960), 4.0, "a camera of 1281 x 960 px at 'front'"),
        (CameraSpec(fov_deg=10.0, mount="left"), 20.0, "a camera of 10 deg, 20 Hz at 'left'"),
        (
            CameraSpec(mount=Mount((6.0, 0.0, 18.0), 80.0)),
            4.0,
            "a camera of its own at (6, 0, 18) m, 80 deg down, 0 to the left",
        ),
        (
            CameraSpec(mount=COURIER.mounts["front"]),
            4.0,
            "a camera of its own at (0.3, 0, 0.62) m, 10 deg down, 0 to the left",
        ),
    ],
    ids=[
        "blind",
        "standard",
        "wide-mast",
        "at-the-limits",
        "large",
        "side",
        "far-eye",
        "front-by-its-place",
    ],
)
def test_a_camera_beyond_its_mount_is_reported(
    camera: CameraSpec | None, rate_hz: float, expected: str
) -> None:
    """Place, size, field of view and rate are checked against the mount, and a crop does not reduce
    the size."""
    assert nonstandard(Manifest("mine", rate_hz=rate_hz, camera=camera), COURIER) == expected


def test_an_unknown_camera_is_refused_with_the_valid_ones(
    tmp_path: Path,
) -> None:
    """An Episode and a run refuse it before anything starts, with the remedy."""
    with pytest.raises(UsageError) as caught:
        Episode(SHORT, FarEye.manifest)
    assert str(caught.value).startswith(
        "policy 'far-eye' sees by a camera of its own at (6, 0, 18) m, 80 deg down"
    )
    for words in (
        "'front' at (0.3, 0, 0.62) m, 10 deg down; up to 1280 x 960 px, 20 to 120 deg, 20 Hz",
        "'left' at (0.1, 0.25, 0.58) m, 10 deg down, 60 deg to the left; up to",
        "--own-camera",
    ):
        assert words in str(caught.value)
    with pytest.raises(UsageError, match="which marks every row as nonstandard"):
        run("reactive", FarEye(), episodes=1, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    Episode(SHORT, FarEye.manifest, EpisodeOptions(own_camera=True))


def test_every_record_and_row_has_the_camera_of_the_policy() -> None:
    """Records, also of crashed episodes, have the camera, the rate, and what is nonstandard about
    it."""
    manifest = Manifest(
        "mine",
        rate_hz=5.0,
        camera=CameraSpec(512, 288, 60.0, crop=(0, 88, 512, 288), lens=Lens(k1=0.1)),
    )
    record = record_of(SHORT, manifest)
    far = record_of(SHORT, FarEye.manifest)
    assert (record.manifest.camera, record.manifest.rate_hz, record.nonstandard) == (
        manifest.camera,
        5.0,
        "",
    )
    row = table_row(record)
    assert row["camera"] == "front, 512 x 288 px, 60 deg, crop 0 88 512 288, lens"
    assert (
        row["rate_hz"],
        row["nonstandard"],
        table_row(record_of(SHORT, Manifest("b", camera=None)))["camera"],
    ) == (
        5.0,
        "",
        "none",
    )
    assert (
        table_row(far)["nonstandard"]
        == "a camera of its own at (6, 0, 18) m, 80 deg down, 0 to the left"
    )
    on_scout = record_of(
        msgspec.structs.replace(SHORT, robot="scout"),
        Manifest("m", camera=CameraSpec(mount="left")),
    )
    assert (
        on_scout.nonstandard
        == nonstandard(Manifest("m", camera=CameraSpec(mount="left")), SCOUT)
        == ""
    )


@pytest.mark.parametrize(
    "crop",
    [(0, 0, 97, 96), (5, 0, 5, 96), (-1, 0, 9, 9), (9, 9, 5, 20), (0, 0, 9)],
    ids=lambda crop: str(crop),
)
def test_a_crop_outside_the_picture_is_refused(crop: tuple[int, int, int, int]) -> None:
    """The message has the size of the whole picture."""
    with pytest.raises(
        SpecError, match=r"camera crop must be \(x0, y0, x1, y1\) within 96 x 96 pixels"
    ):
        CameraSpec(96, 96, crop=crop)


@pytest.mark.engine
@pytest.mark.parametrize(
    "lens", [Lens(), Lens(k1=0.1, full_well_e=10000.0)], ids=["pinhole", "lens"]
)
@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(
            "gl",
            marks=pytest.mark.skipif(not context.available(), reason="no OpenGL through EGL here"),
        ),
        "bullet",
    ],
)
def test_a_crop_is_the_slice_of_the_whole_picture(camera: str, lens: Lens) -> None:
    """Colours, labels and depth of columns 10 to 50, rows 4 to 30, are equal to the bit under any
    lens."""
    world = BulletWorld(StreetSurface(tiny_map(), 1), (), COURIER)
    robot = RobotState(Pose(-40.0, 100.0, 0.2), 1.0)
    frames = []
    street = Street(3, People.of(("c1",), [[-36.0, 101.0]], [0.0], [1.0], ("walk",)))
    for crop in (None, (10, 4, 50, 30)):
        spec = CameraSpec(64, 48, lens=lens, crop=crop)
        with camera_of(camera, world, spec, depth=True) as eyes:  # type: ignore[arg-type]
            frames.append(eyes.render(robot, street))
    uncropped, part = frames
    assert spec.size == (40, 26) and part.rgb.shape == (26, 40, 3)
    assert len(np.unique(uncropped.rgb)) > 10
    for expected, other in (
        (uncropped.rgb, part.rgb),
        (uncropped.labels, part.labels),
        (uncropped.depth, part.depth),
    ):
        assert (
            expected is not None
            and other is not None
            and np.array_equal(expected[4:30, 10:50], other)
        )


@pytest.mark.engine
def test_a_run_with_a_custom_camera_marks_every_row(tmp_path: Path) -> None:
    """Rows, records and run.json are marked, and the policy gets the camera that its manifest
    requests."""
    short = msgspec.structs.replace(small_scenario(), time_limit_s=0.5)
    suite = Suite(name="small", version="1", scenarios=(short,))
    options = EpisodeOptions(own_camera=True, camera="bullet", seed=1)
    table = run(suite, FarEye(), out=tmp_path / "run", options=options)
    assert list(table["nonstandard"]) == [
        "a camera of its own at (6, 0, 18) m, 80 deg down, 0 to the left"
    ]
    assert list(table["camera"]) == ["own mount, 64 x 64 px, 75 deg"]
    (record,) = read_records(tmp_path / "run")
    assert (
        record.manifest.camera
        == FarEye.manifest.camera
        == read_spec(tmp_path / "run").manifest.camera
    )
