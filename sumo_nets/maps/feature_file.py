"""Store the features of an imported map next to its net, as compact JSON that is validated when
read."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import shapely
from shapely.geometry import Polygon

from cosim.core.errors import MapError
from cosim.place.street_map import LAND_KINDS, Feature, FeatureKind

_SCHEMA = 1
FEATURES_FILE = "features.json"


class _Row(msgspec.Struct, frozen=True, array_like=True):
    kind: FeatureKind
    x_m: float
    y_m: float
    heading_rad: float
    height_m: float
    rings: list[list[tuple[float, float]]]


class _Stored(msgspec.Struct, frozen=True):
    schema: int
    features: list[_Row]


def write_features(features: Sequence[Feature], path: Path) -> None:
    """Write features to `path`."""
    rows = [
        _Row(f.kind, f.x_m, f.y_m, f.heading_rad, f.height_m, _rings(f.polygon)) for f in features
    ]
    path.write_bytes(msgspec.json.encode(_Stored(_SCHEMA, rows)))


def read_features(path: Path) -> tuple[Feature, ...]:
    """Return the features at `path`, empty without a file. Raises MapError if it is damaged."""
    try:
        stored = msgspec.json.decode(path.read_bytes(), type=_Stored)
        if stored.schema != _SCHEMA:
            raise ValueError(f"schema {stored.schema}; this version reads {_SCHEMA}")
        return tuple(_feature(row) for row in stored.features)
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, msgspec.DecodeError, shapely.errors.GEOSException) as error:
        raise MapError(f"{path}: cannot be read: {error}: import the map again") from error


def with_features(net_hash: str, path: Path) -> str:
    """Return the content hash of a map, from its net's hash and the feature file, if any."""
    try:
        features = path.read_bytes()
    except OSError:
        return net_hash
    return hashlib.sha256(net_hash.encode() + features).hexdigest()[:16]


def _feature(row: _Row) -> Feature:
    polygon = Polygon(row.rings[0], row.rings[1:]) if row.rings else Polygon()
    numbers = (row.x_m, row.y_m, row.heading_rad, row.height_m)
    if not all(map(math.isfinite, numbers)) or row.height_m < 0.0:
        raise ValueError(f"a {row.kind} with numbers that cannot be: {numbers}")
    if (row.kind in ("building", *LAND_KINDS)) != (not polygon.is_empty and polygon.is_valid):
        raise ValueError(
            f"a {row.kind} at ({row.x_m:g}, {row.y_m:g}) whose outline does not fit it"
        )
    return Feature(row.kind, row.x_m, row.y_m, row.heading_rad, row.height_m, polygon)


def _rings(polygon: Polygon) -> list[list[tuple[float, float]]]:
    if polygon.is_empty:
        return []
    rings = [shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors)]
    return [[(x, y) for x, y in ring.tolist()] for ring in rings]
