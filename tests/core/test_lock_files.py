"""The lock files: everyone installs the same versions, because these give the same bits."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from cosim.core.versions import RECORDED_PACKAGES, versions

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def locked(name: str) -> dict[str, str]:
    """Return the version of each package of a lock file."""
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / name).read_text(), re.MULTILINE))


@pytest.mark.parametrize(
    "name", ["requirements.lock", "requirements-dev.lock", "requirements-docs.lock"]
)
def test_every_locked_package_has_hashes_and_no_source(name: str) -> None:
    """A lock file has packages, versions and hashes only: no host, no folder, no local version."""
    text = re.sub(r"^#.*\n", "", (ROOT / name).read_text(), flags=re.MULTILINE)
    entry = r"[a-z0-9-]+==[0-9][0-9a-z.]* \\\n(    --hash=sha256:[0-9a-f]{64} \\\n)*    --hash=sha256:[0-9a-f]{64}\n"
    assert re.fullmatch(f"({entry})+", text)


def test_the_lock_files_satisfy_every_requirement() -> None:
    """Every requirement, also of the build, is locked within its range; the files for tests, site
    and runs agree."""
    run, dev = locked("requirements.lock"), locked("requirements-dev.lock")
    site = locked("requirements-docs.lock")
    assert run.items() <= dev.items() and run.items() <= site.items()
    assert all(dev.get(name, version) == version for name, version in site.items())
    project, groups = PROJECT["project"], PROJECT["dependency-groups"]
    for line in (*project["dependencies"], *groups["build"], *PROJECT["build-system"]["requires"]):
        requirement = Requirement(line)
        assert requirement.specifier.contains(run[canonicalize_name(requirement.name)]), line
    for extra, pinned in (("dev", dev), ("docs", site)):
        for line in project["optional-dependencies"][extra]:
            requirement = Requirement(line)
            assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), line


def test_installed_versions_are_the_locked_ones() -> None:
    """The tests run with the locked versions."""
    found: dict[str, str] = {}
    for name in locked("requirements-dev.lock"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    assert found == locked("requirements-dev.lock"), "set up again: make test"


def test_everything_is_installed_from_the_lock_files() -> None:
    """Makefile and container install with hashes, and besides only the project; CI uses make."""
    for name, kinds in (("Makefile", 2), ("Containerfile", 2), (".ci/run", 0)):
        lines = [
            line
            for line in (ROOT / name).read_text().splitlines()
            if re.search(r"(pip|PIP\)) install", line) and "install --quiet uv" not in line
        ]
        hashed = [line for line in lines if "--require-hashes" in line]
        project = [line for line in lines if "--no-deps --no-build-isolation" in line]
        assert bool(hashed) + bool(project) == kinds, f"{name}: {lines}"
        assert [line for line in lines if line not in (*hashed, *project)] == [], name
    assert "make test" in (ROOT / ".ci/run").read_text()


def test_a_record_has_every_version_that_can_change_results() -> None:
    """Versions of engines, numerics, the libraries inside them and the renderer are recorded."""
    assert set(RECORDED_PACKAGES) - {"sidewalk-cosim"} <= set(locked("requirements.lock"))
    assert {
        "libsumo",
        "pybullet",
        "osmium",
        "moderngl",
        "glcontext",
        "opencv-python-headless",
    } < set(versions())
    assert re.fullmatch(r"3\.\d+\.\d+", versions()["geos"])
    assert re.fullmatch(r"[0-9a-f]{16}", versions()["arithmetic"])
