"""Steps of an import that use netconvert and SUMO: cropping, walkways, widths, test start."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from cosim.core.errors import MachineError, MapError
from cosim.core.progress import Progress
from cosim.place.map_check import NetFacts
from sumo_nets.maps.osm_crop import Box, refuse_box_outside
from sumo_nets.maps.osm_file import MapFile
from sumo_nets.maps.sidewalks import set_widths
from sumo_nets.net.net_facts import net_root, read_facts
from sumo_nets.net.net_file import allows
from sumo_nets.net.netconvert import error_summary, netconvert, sumo_home

TIMEOUT_S = 300.0
"""Timeout of each netconvert call, seconds."""
START_TIMEOUT_S = 60.0
"""Timeout of the test start of SUMO, seconds."""
UPGRADE_OPTIONS: Final = ("--sidewalks.guess", "--crossings.guess", "--walkingareas")
FOOT_TYPES: Final = ("highway.footway", "highway.pedestrian", "highway.steps", "highway.path")
FOOT_MPS: Final = 1.4
"""An edge of one lane with at most this speed limit is a footway, whatever vehicles it permits,
m/s."""


@dataclass(slots=True)
class ImportWork:
    """An import in progress.

    folder: for scratch files.
    progress: receives the stages of the work.
    changes: changes to the map so far, a sentence each.
    """

    file: MapFile
    folder: Path
    progress: Progress
    changes: list[str] = field(default_factory=list)

    def netconvert(self, stage: str, name: str, arguments: Sequence[str]) -> Path:
        """Build the net `name` in the scratch folder."""
        self.progress(stage, 0.0)
        return netconvert(
            arguments, self.folder / name, TIMEOUT_S, lambda share: self.progress(stage, share)
        )

    def written(self, root: ET.Element, name: str) -> Path:
        """Write a net into the scratch folder."""
        path = self.folder / name
        ET.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)
        return path


def crop_net(work: ImportWork, net: Path, box: Box | None) -> Path:
    """Return the net inside a box. Raises MapError, with the bounds of the map, for an empty
    box."""
    if box is None:
        return net
    projected = read_facts(net).projected
    source = work.file.source
    bounds = _bounds(net, projected)
    unit = "degrees" if projected else "metres: the net has no projection"
    if bounds is not None:
        refuse_box_outside(source, box, bounds, unit)
    option = "--keep-edges.in-geo-boundary" if projected else "--keep-edges.in-boundary"
    bbox = ",".join(f"{v:.7f}" for v in box)
    try:
        # With both options in one call, netconvert does not terminate on some nets.
        inside = work.netconvert("cropping", "inside.net.xml", ["-s", str(net), f"{option}={bbox}"])
        net = work.netconvert(
            "cropping", "cropped.net.xml", ["-s", str(inside), "--keep-edges.components=1"]
        )
    except MapError as error:
        covers = (
            "" if bounds is None else f"; the map covers {','.join(f'{v:.6g}' for v in bounds)}"
        )
        raise MapError(
            f"{source}: cropping to --bbox {bbox} (in {unit}) failed{covers}: {error}"
        ) from error
    work.changes.append(
        f"cropped to {bbox}; whole streets are included, and only the largest connected part"
    )
    return net


def _bounds(net: Path, projected: bool) -> Box | None:
    """Return the bounds of a net, in degrees if it is projected; None if it does not contain
    them."""
    location = net_root(net).find("location")
    boundary = (
        ""
        if location is None
        else location.get("origBoundary" if projected else "convBoundary", "")
    )
    try:
        west, south, east, north = (float(side) for side in boundary.split(","))
    except ValueError:
        return None
    on_earth = -180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0
    return (
        (west, south, east, north)
        if on_earth or (not projected and west < east and south < north)
        else None
    )


def add_walkways(work: ImportWork, net: Path, facts: NetFacts) -> Path:
    """Return the net with sidewalks along slow roads, crossings and walking areas."""
    root = net_root(net)
    freed = 0
    for edge in root.iter("edge"):
        lanes = edge.findall("lane")
        if (
            len(lanes) == 1
            and not edge.get("function")
            and allows(lanes[0].attrib, "pedestrian")
            and _is_footway(edge)
        ):
            freed += allows(lanes[0].attrib, "passenger")
            lanes[0].attrib.pop("disallow", None)
            lanes[0].set("allow", "pedestrian")
    ready = work.written(root, "ready.net.xml")
    # --tls.guess would add signals, some of which SUMO refuses.
    upgraded = work.netconvert(
        "adding sidewalks", "upgraded.net.xml", ["-s", str(ready), *UPGRADE_OPTIONS]
    )
    if freed:
        work.changes.append(f"{freed} footways on which cars were allowed are for people only")
    work.changes.append(
        "sidewalks beside every road up to 50 km/h, crossings and walking areas added (format was "
        f"{facts.version}): lanes are renumbered, junctions grew; bus stops and detectors made for "
        "the old net do not fit any more"
    )
    return upgraded


def _is_footway(edge: ET.Element) -> bool:
    slow = float(edge[0].get("speed", "13.9")) <= FOOT_MPS
    return slow or edge.get("type", "") in FOOT_TYPES


def widen_sidewalks(
    work: ImportWork,
    net: Path,
    widths_m: Mapping[str, float],
    tagged: Mapping[str, Mapping[str, str]],
    before: Collection[str] = (),
) -> Path:
    """Return the net with the widths of guessed sidewalks set, see `set_widths`."""
    root = net_root(net)
    changes = set_widths(root, widths_m, tagged, before)
    if not changes:
        return net
    work.changes += changes
    ready = work.written(root, "widths.net.xml")
    # Wider sidewalks move corners. netconvert drops crossings that miss them and guesses new ones.
    return work.netconvert(
        "widening sidewalks", "widened.net.xml", ["-s", str(ready), "--crossings.guess"]
    )


def start_sumo(file: MapFile, net: Path) -> None:
    """Start SUMO on the net of a map file, as `start_net` does."""
    start_net(net, str(file.source))


def start_net(net: Path, source: str) -> None:
    """Start SUMO on the net for a second: it refuses some nets that netconvert accepts.

    source: name of the map in errors. Raises MapError, MachineError without SUMO.
    """
    command = [
        str(sumo_home() / "bin" / "sumo"),
        "-n",
        str(net),
        "-e",
        "1",
        "--no-step-log",
        "--no-warnings",
    ]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=START_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise MapError(
            f"{source}: SUMO did not start on the net within {START_TIMEOUT_S:g} s"
        ) from error
    except OSError as error:
        raise MachineError(
            f"sumo cannot be run: {error.strerror}: is eclipse-sumo installed?"
        ) from error
    if done.returncode != 0:
        ended = f"(sumo -n NET -e 1 ends with {done.returncode})"
        raise MapError(f"{source}: SUMO refuses the net {ended}{error_summary(done.stderr)}")
