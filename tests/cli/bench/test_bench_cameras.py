"""`cosim bench camera` where a camera cannot draw: real processes, real EGL without a vendor."""

from __future__ import annotations

import importlib
import os
from functools import partial
from pathlib import Path

import pytest

from scenarios.tools.bench import cameras as bench_cameras
from scenarios.tools.bench.cameras import Drawing, time_cameras, whole_frame
from tests.conftest import Cosim

pytestmark = pytest.mark.engine


def test_what_cannot_be_drawn_is_told_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosim: Cosim
) -> None:
    """No OpenGL, a package that is missing, a process that dies: each figure has its words; others
    are taken."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))
    figures = (
        Drawing("by gl", partial(whole_frame, "gl", 3, 2), 200.0),
        Drawing("by a package", partial(importlib.import_module, "nowhere"), ""),  # type: ignore[arg-type]
        Drawing("by who dies", os._exit, 3),
        Drawing("by gl again", partial(whole_frame, "gl", 3, 2), 200.0),
        Drawing("by bullet", partial(whole_frame, "bullet", 3, 2), 200.0),
    )
    found = time_cameras(1, lambda _: None, figures)
    assert [len(found[figure.name].fps) for figure in figures] == [0, 0, 0, 0, 1]
    assert "apt-get install libegl1" in found["by gl"].why and "OpenGL 4.3" in found["by gl"].why
    assert found["by a package"].why == "ModuleNotFoundError: No module named 'nowhere'"
    assert "process" in found["by who dies"].why and "exit code 3" in found["by who dies"].why
    assert found["by bullet"].why == ""
    monkeypatch.setattr(bench_cameras, "FIGURES", figures)
    monkeypatch.setattr(bench_cameras, "RATIOS", (("gl / bullet", "by gl", "by bullet", ">= 5"),))
    monkeypatch.setattr(bench_cameras, "time_cameras", lambda *_: found)
    said = cosim("bench", "camera", "--rounds", "1")
    assert said.returncode == 0, said.stderr
    told = " ".join(said.stdout.split())
    assert (
        "by a package cannot be drawn here: ModuleNotFoundError: No module named 'nowhere'" in told
    )
    assert (
        "by gl; by gl again cannot be drawn here: the gl camera" in told
        and told.count("apt-get") == 1
    )
    assert "`cosim doctor`" in told and "see below" in told
