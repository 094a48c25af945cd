"""Choice of the camera, and messages where OpenGL is missing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import moderngl
import pytest

from cosim.core.errors import EngineError, RunError
from cosim.results.run_folder import RunFolder
from cosim.spec.scenario import Suite
from physics.cameras import choice as cameras
from physics.cameras.gl import context
from tests.run_specs import spec_of


@pytest.fixture
def without_opengl(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Simulate a machine without the EGL library."""

    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("libEGL.so not loaded")

    monkeypatch.setattr(moderngl, "create_context", fails)
    held = context.context, context.available
    for made in held:
        monkeypatch.setattr(context, made.__name__, lru_cache(made.__wrapped__))
    yield


def test_auto_falls_back_to_bullet_without_opengl(without_opengl: None) -> None:
    """Where no context can be made, auto selects bullet and the name of its renderer is
    unchanged."""
    assert cameras.camera_of_choice("auto") == "bullet"
    assert cameras.renderer_of("bullet") == "bullet-tiny"


def test_gl_without_opengl_names_the_packages(without_opengl: None) -> None:
    """The error has the reason, the packages to install, and the alternative."""
    with pytest.raises(
        EngineError, match=r"libEGL.so not loaded.*apt-get install libegl1 .*--camera bullet"
    ):
        cameras.camera_of_choice("gl")


def test_a_run_does_not_mix_renderers(tmp_path: Path) -> None:
    """Resuming with another renderer is refused, and the message names both."""
    suite = Suite(name="s", version="1", scenarios=())
    spec = spec_of(suite, renderer="bullet-tiny")
    with RunFolder.create(tmp_path / "run", spec, suite):
        pass
    other = spec_of(suite, renderer="gl: other")
    with pytest.raises(
        RunError, match="its renderer is bullet-tiny, and this command has gl: other"
    ):
        RunFolder.resume(tmp_path / "run", other)


def test_naming_cameras_starts_no_engine() -> None:
    """The camera can be chosen without importing PyBullet."""
    code = (
        "import sys, physics.cameras.choice as c; c.camera_of_choice('auto'); print('pybullet' "
        "in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.engine
@pytest.mark.skipif(
    not context.available(), reason="no OpenGL through EGL here (see `cosim doctor`)"
)
def test_the_name_of_the_gl_renderer_has_device_and_version() -> None:
    """Records distinguish a GPU from llvmpipe, and their versions."""
    assert len(cameras.renderer_of("gl")) > len("gl: , 4.3")
