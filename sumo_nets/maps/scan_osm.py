"""Areas of a scan from an OpenStreetMap file around it."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import pyproj
import shapely

from cosim.core.errors import MapError
from cosim.core.geometry import Floats
from cosim.core.progress import Progress, ignore
from cosim.place import overlay
from cosim.place.scan import AreaKind, Georeference, ScanArea
from cosim.place.scan_areas import to_local
from cosim.place.street_map import StreetMap
from sumo_nets.maps.importer import Options, convert
from sumo_nets.net.net_facts import net_root
from sumo_nets.net.net_file import read_net

_AROUND_M: Final = 150.0
"""Width of the map around the scan in metres, so that streets at its edge are whole."""
_DEGREE_M: Final = 111_000.0
_SPECK_M2: Final = 0.5


def osm_areas(
    path: Path,
    georeference: Georeference,
    half_size_m: float,
    progress: Progress = ignore,
) -> tuple[tuple[ScanArea, ...], tuple[str, ...]]:
    """Return the areas of a map in the net's frame of a scan, and the licences of the map.

    half_size_m: distance from the georeference to the farthest edge of the scan.

    Raises MapError for an unusable map.
    """
    north = (half_size_m + _AROUND_M) / _DEGREE_M
    east = north / max(0.1, math.cos(math.radians(georeference.latitude_deg)))
    lat, lon = georeference.latitude_deg, georeference.longitude_deg
    box = (lon - east, lat - north, lon + east, lat + north)
    with TemporaryDirectory() as scratch:
        done = convert(path, Path(scratch), Options(bbox=box), progress)
        location = net_root(done.net).find("location")
        street_map = read_net(done.net)
    if location is None or location.get("projParameter", "!") in ("", "!", "-"):
        raise MapError(f"{path}: has no projection: give an OpenStreetMap file")
    projection = pyproj.Proj(location.attrib["projParameter"])
    offset = np.array([float(one) for one in location.attrib["netOffset"].split(",")])

    def to_scan(xy: Floats) -> Floats:
        lonlat = projection(xy[:, 0] - offset[0], xy[:, 1] - offset[1], inverse=True)
        return to_local(np.column_stack(lonlat), georeference)

    areas = tuple(
        ScanArea(area.kind, shapely.transform(area.polygon, to_scan))
        for area in areas_of_map(street_map)
    )
    return areas, done.licences


def areas_of_map(street_map: StreetMap) -> list[ScanArea]:
    """Return the ground of a street map as areas that do not overlap, but for crossings."""
    strips = street_map.strips.values()
    walks = overlay.union_all(
        [strip.polygon for strip in strips if strip.kind == "sidewalk"]
        + [corner.polygon for corner in street_map.corners.values()]
    )
    lanes = street_map.lanes.values()
    roads = overlay.union_all(
        [lane.polygon for lane in lanes if lane.kind == "road"]
        + [junction.polygon for junction in street_map.junctions.values()]
    )
    verges = overlay.union_all([lane.polygon for lane in lanes if lane.kind == "verge"])
    crossings = [strip.polygon for strip in strips if strip.kind == "crossing"]
    kinds: list[tuple[AreaKind, shapely.Geometry]] = [
        ("sidewalk", walks),
        ("road", overlay.difference(roads, walks)),
        ("verge", overlay.difference(verges, overlay.union_all([walks, roads]))),
        *(("crossing", crossing) for crossing in crossings),
    ]
    return [
        ScanArea(kind, part)
        for kind, shape in kinds
        for part in shapely.get_parts(shape)
        if isinstance(part, shapely.Polygon) and part.area > _SPECK_M2
    ]
