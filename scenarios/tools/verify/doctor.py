"""Checks of `cosim doctor`: every engine runs a small real task."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from importlib.metadata import packages_distributions
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np

from cosim.core.cache import cache_folder
from cosim.core.errors import EngineError, MachineError
from cosim.core.versions import versions
from cosim.place.walk_graph import WalkGraph
from cosim.spec.events import EventQuery
from cosim.spec.manifest import Manifest
from cosim.spec.robot import COURIER
from cosim.spec.scenario import City, CrowdSpec, Scenario
from physics.cameras.choice import camera_of_choice, renderer_of
from scenarios.episodes.director import in_process_director
from scenarios.episodes.episode import Episode
from scenarios.ipc.sandbox import KINDS
from scenarios.places.nets import place
from scenarios.runs.isolated_policy import sandbox_lacks
from scenarios.suites.long_horizon import build_long_horizon

_SMALL = City(seed=1, size_m=500.0)
_SEEING = Manifest("doctor")
"""Manifest of a policy with the default camera."""
OWN = ("cosim", "sumo_nets", "physics", "bridge", "scenarios")


def packages() -> str:
    return ", ".join(f"{name} {version}" for name, version in versions().items())


def names() -> str:
    """Check that the top-level packages are not those of another distribution with the same
    name.
    """
    owners = packages_distributions()
    for name in OWN:
        if (owner := set(owners.get(name, ["sidewalk-cosim"]))) != {"sidewalk-cosim"}:
            raise MachineError(
                f"package '{name}' belongs to {', '.join(sorted(owner))}: use a virtual environment"
            )
    return f"{', '.join(OWN)} are this project's"


def cache() -> str:
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder):
        return f"{folder} can be written"


def city() -> str:
    net, street_map = place(_SMALL)
    return (
        f"netconvert built {Path(net).name}: {len(street_map.strips)} strips, "
        f"{len(street_map.corners)} corners"
    )


def bridge() -> str:
    query = EventQuery(
        episode="doctor",
        tick=0,
        tick_ms=50,
        robot_x_m=0.0,
        robot_y_m=0.0,
        robot_heading_rad=0.0,
        robot_v_mps=0.0,
        robot_w_radps=0.0,
        route_s_m=0.0,
        robot_length_m=COURIER.length_m,
        robot_width_m=COURIER.width_m,
        events=(),
    )
    with in_process_director("doctor") as director:
        director.react(query)
    return "a director answered over a Zenoh session"


def cameras() -> str:
    """Return which camera `--camera auto` chooses, and why."""
    try:
        return f"gl works and is taken ({renderer_of(camera_of_choice('gl'))}); so does bullet"
    except EngineError as error:
        return f"bullet works and is taken; gl does not: {error}"


def frame() -> str:
    """Run one frame and one step of a small city, with crowd and physics."""
    scenario = small_scenario()
    with Episode(scenario, _SEEING) as episode:
        picture = episode.reset().rgb
        if picture is None or len(np.unique(picture.reshape(-1, 3), axis=0)) < 5:
            raise EngineError("the camera's picture is blank")
        height, width, _ = picture.shape
        people = len(episode.moment.street.people)
        renderer = episode.record.setup.renderer
        return (
            f"SUMO walks {people} people, PyBullet holds the robot, {renderer} draws "
            f"{width}x{height}"
        )


def small_scenario() -> Scenario:
    """Build a long-horizon scenario in a small city with a small crowd."""
    _, street_map = place(_SMALL)
    scenario = build_long_horizon(_SMALL, street_map, WalkGraph(street_map), 0, "doctor")
    return msgspec.structs.replace(scenario, crowd=CrowdSpec(persons=10, radius_m=50.0, vehicles=4))


def sandbox() -> str:
    """Return which kinds of sandboxes `--isolated` finds, and what the others lack."""
    lacks = {kind: sandbox_lacks(kind) for kind in KINDS}
    works = [kind for kind, why in lacks.items() if not why]
    found = f"--isolated takes {works[0]}" if works else "none; --isolated=weak protects less"
    also = [f"{kind} works, too" for kind in works[1:]]
    missing = [f"no {kind}: {why}" for kind, why in lacks.items() if why]
    return "; ".join([found, *also, *missing])


CHECKS: Mapping[str, Callable[[], str]] = MappingProxyType(
    {
        "packages": packages,
        "names": names,
        "cache": cache,
        "city": city,
        "bridge": bridge,
        "cameras": cameras,
        "frame": frame,
        "sandbox": sandbox,
    }
)
