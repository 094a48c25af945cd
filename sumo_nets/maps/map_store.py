"""Store of imported maps in the cache folder, including SUMO's own nets."""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import msgspec

from cosim.core.cache import cache_folder
from cosim.core.errors import MapError, UsageError, unknown, unwritable
from cosim.core.files import atomic_folder, folder_holds
from cosim.core.progress import Progress, ignore
from cosim.place.map_check import MapCheck, check_map
from cosim.place.street_map import StreetMap
from cosim.spec.scenario import CityMap, Place
from sumo_nets.maps.feature_file import FEATURES_FILE, read_features, with_features, write_features
from sumo_nets.maps.ground_file import GROUND_FILE, with_drawn_ground, with_scan
from sumo_nets.maps.import_rules import IMPORTER_VERSION, WHEEL_PLACES
from sumo_nets.maps.importer import OSM_LICENCE, Options, convert
from sumo_nets.net.net_facts import read_facts
from sumo_nets.net.netconvert import sumo_home
from sumo_nets.net.raw_file import net_content_hash, read_head
from sumo_nets.net.snapshot import street_map_of

ABOUT = "about.json"
OSM_CREDIT = "(c) OpenStreetMap contributors, ODbL"
"""Credit on pictures of places made from OpenStreetMap data; picture fonts have no copyright
sign."""
GENERIC_FILE_NAMES = (
    "input",
    "map",
    "net",
    "network",
    "osm",
    "converted",
    "export",
    "planet",
    "osm_bbox",
)
"""Generic file names, for which the folder's name is used instead."""
MAP_NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
GAME_LICENCE = "EPL-2.0 OR GPL-2.0-or-later, with Eclipse SUMO"


class About(msgspec.Struct, frozen=True, kw_only=True):
    """Origin of an imported map and its changes.

    source_hash: SHA-256 of the file, 16 hex digits.
    versions: of the importer (`import_rules.py`) and of SUMO.
    """

    name: str
    source: str
    source_hash: str
    format: str
    imported_at: str
    bbox: tuple[float, float, float, float] | None
    lefthand: bool | None
    as_is: bool = False
    sidewalk_width_m: float | None = None
    versions: dict[str, str]
    changes: tuple[str, ...]
    guessed_share: float | None
    licences: tuple[str, ...]
    net_hash: str


class KnownMap(msgspec.Struct, frozen=True):
    """A known place.

    origin: "imported" or "sumo" (in the SUMO package, imported on first use).
    """

    name: str
    origin: str
    source: str


def maps_folder() -> Path:
    """Return the folder of imported maps."""
    return cache_folder() / "maps"


def import_map(
    source: Path,
    name: str | None = None,
    options: Options | None = None,
    progress: Progress = ignore,
) -> About:
    """Import a map file under a name, by default the file's, and replace an earlier map of that
    name.

    Raises MapError when the file gives no usable net, UsageError for an unusable name. Then nothing
    is stored.
    """
    name = map_name(source) if name is None else name
    _check_name(name)
    options = Options() if options is None else options
    if name in _supplied():
        if source != _supplied()[name] or options != Options():
            raise UsageError(
                f"'{name}' is the name of a net that comes with SUMO: choose another with --name"
            )
        options = _supplied_options(name)
    return _store(source, name, options, progress)


def map_name(source: Path) -> str:
    """Return the default name of a map file."""
    stem = re.sub(r"\.(gz|bz2|pbf|xml|osm|net)$", "", source.name)
    while (shorter := re.sub(r"\.(gz|bz2|pbf|xml|osm|net)$", "", stem)) != stem:
        stem = shorter
    if stem.lower() in GENERIC_FILE_NAMES and source.resolve().parent.name:
        stem = source.resolve().parent.name
    return re.sub(r"[^a-z0-9._-]+", "-", stem.lower()).strip("-._")[:64] or "map"


def map_net(place: CityMap | str) -> Path:
    """Return the street net of an imported or SUMO-supplied map.

    A SUMO-supplied one is imported again where another version of the importer made it.

    Raises UsageError for an unknown name, MapError when `place` has the hash of another net.
    """
    name = place if isinstance(place, str) else place.map
    path = maps_folder() / name / "net.xml"
    if not MAP_NAME_PATTERN.fullmatch(name) or not folder_holds(path.parent, path.name):
        supplied = _supplied()
        if name not in supplied:
            raise unknown("map", name, known_maps())
        _store(supplied[name], name, _supplied_options(name), in_place=False)
    elif name in _supplied() and _is_outdated(path.parent):
        _store(_supplied()[name], name, _supplied_options(name))
    if (
        not isinstance(place, str)
        and place.net_hash
        and (found := map_hash(path)) != place.net_hash
    ):
        raise MapError(
            f"map '{name}': its hash is {found}, but the scenario was made on "
            f"{place.net_hash}: import the same "
            "file with the same options and versions again, or build the scenarios again"
        )
    return path


def _is_outdated(folder: Path) -> bool:
    """Return whether a stored map is unreadable or of another version of the importer."""
    try:
        return outdated(msgspec.json.decode((folder / ABOUT).read_bytes(), type=About))
    except (OSError, msgspec.DecodeError, msgspec.ValidationError):
        return True


def read_map(place: CityMap | str) -> StreetMap:
    """Return the StreetMap of a map, under the map's name, with its features and drawn ground."""
    name = place if isinstance(place, str) else place.map
    path = map_net(place)
    street_map = with_drawn_ground(street_map_of(path), path.with_name(GROUND_FILE))
    features = read_features(path.with_name(FEATURES_FILE))
    known_as = with_scan(
        with_features(street_map.net_hash, path.with_name(FEATURES_FILE)), path.parent
    )
    whole = dataclasses.replace(street_map, name=name, features=features, net_hash=known_as)
    return whole.with_input_hash(f"{street_map.input_hash}-{known_as}")


def map_hash(net: Path) -> str:
    """Return the content hash of a map, of its net and the features and scan next to it."""
    return with_scan(with_features(net_content_hash(net), net.with_name(FEATURES_FILE)), net.parent)


def file_hash(path: Path) -> str:
    """Return the SHA-256 (16 hex digits) of a file. Raises MapError when it cannot be read."""
    read_head(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def about_map(name: str) -> About:
    """Return the origin of a map, and import a SUMO-supplied one first."""
    path = map_net(name).with_name(ABOUT)
    try:
        return msgspec.json.decode(path.read_bytes(), type=About)
    except (OSError, msgspec.DecodeError, msgspec.ValidationError) as error:
        raise MapError(f"{path}: cannot be read: {error}: import the map '{name}' again") from error


def credit_of(place: Place) -> str:
    """Return the credit that pictures of a place need; "" if its map is not known to be from
    OpenStreetMap."""
    if not isinstance(place, CityMap):
        return ""
    try:
        licences = about_map(place.map).licences
    except (MapError, UsageError):
        return ""
    return OSM_CREDIT if OSM_LICENCE in licences else ""


def checked_map(name: str) -> tuple[StreetMap, MapCheck, About]:
    """Return a map, its check and its origin."""
    about, street_map = about_map(name), read_map(name)
    return (
        street_map,
        check_map(street_map, None, read_facts(map_net(name)), about.guessed_share),
        about,
    )


def delete_map(name: str) -> Path:
    """Delete an imported map, and return its former folder.

    Raises UsageError for a map that is not imported, MachineError if it cannot be deleted.
    """
    folder = maps_folder() / name
    imported = sorted(one.name for one in known_maps().values() if one.origin == "imported")
    if name not in imported:
        raise unknown("imported map", name, imported)
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise unwritable(folder, error) from error
    return folder


def known_maps() -> dict[str, KnownMap]:
    """Return all places by name: imported maps, then nets with sidewalks from SUMO, whole and as
    crops."""
    folder = maps_folder()
    found = sorted(p.parent for p in folder.glob(f"*/{ABOUT}")) if folder.is_dir() else []
    supplied = _supplied()
    known = {
        p.name: KnownMap(p.name, "imported", _source_of(p.name))
        for p in found
        if p.name not in supplied
    }
    return known | {name: KnownMap(name, "sumo", path.name) for name, path in supplied.items()}


def outdated(about: About) -> bool:
    """Return whether importing the map again would apply newer rules."""
    return about.versions.get("importer") != str(IMPORTER_VERSION)


def _source_of(name: str) -> str:
    try:
        return about_map(name).source
    except MapError:
        return "damaged: import it again"


def store_map(name: str, fill: Callable[[Path], About]) -> About:
    """Store a map that `fill` writes into a temporary folder, replace an earlier one of that name,
    and return its origin.

    fill: writes `net.xml` and what belongs to it, and returns the origin without its hash.
    Raises what `fill` raises, UsageError for an unusable name, MachineError for a full disk.
    Then nothing is stored.
    """
    _check_name(name)
    if name in _supplied():
        raise UsageError(
            f"'{name}' is the name of a net that comes with SUMO: choose another with --name"
        )
    return _stored(name, fill, "replace")


def _check_name(name: str) -> None:
    if not MAP_NAME_PATTERN.fullmatch(name):
        raise UsageError(
            f"'{name}' cannot name a map: use a-z, 0-9, '.', '_' and '-', at most 64 characters"
        )


def _stored(
    name: str, fill: Callable[[Path], About], existing: Literal["replace", "keep"]
) -> About:
    """Let `fill` write a map into a temporary folder, then move it into place."""
    folder = maps_folder()
    try:
        with atomic_folder(folder / name, existing=existing) as ready:
            about = fill(ready)
            about = msgspec.structs.replace(about, net_hash=map_hash(ready / "net.xml"))
            (ready / ABOUT).write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=2))
        return about
    except OSError as error:
        raise unwritable(folder, error, "set COSIM_CACHE to another folder") from error


def _store(
    source: Path, name: str, options: Options, progress: Progress = ignore, *, in_place: bool = True
) -> About:
    """Convert a map and store it."""

    def fill(ready: Path) -> About:
        with TemporaryDirectory(dir=ready) as scratch:
            converted = convert(source, Path(scratch), options, progress)
            converted.net.rename(ready / "net.xml")
        if converted.features:
            write_features(converted.features, ready / FEATURES_FILE)
        return About(
            name=name,
            source=source.name,
            source_hash=file_hash(source),
            format=" ".join(
                filter(None, (converted.format, converted.facts.version, converted.packing))
            ),
            imported_at=datetime.now(UTC).isoformat(timespec="seconds"),
            bbox=options.bbox,
            lefthand=options.lefthand,
            as_is=options.as_is,
            sidewalk_width_m=options.sidewalk_width_m,
            versions={
                "importer": str(IMPORTER_VERSION),
                "eclipse-sumo": version("eclipse-sumo"),
            },
            changes=converted.changes,
            guessed_share=converted.guessed_share,
            licences=_licences(name, source, converted.licences),
            net_hash="",
        )

    return _stored(name, fill, "replace" if in_place else "keep")


def _licences(name: str, source: Path, found: tuple[str, ...]) -> tuple[str, ...]:
    """Return the licences from the file itself and from texts in its folder."""
    licences = list(found)
    if source in _supplied().values():
        licences.append(GAME_LICENCE)
    if name in WHEEL_PLACES and WHEEL_PLACES[name].osm:
        licences.append(OSM_LICENCE)
    return (*licences, *licence_texts(source.resolve().parent))


def licence_texts(folder: Path) -> tuple[str, ...]:
    """Return the texts of the licence files in a folder."""
    licences = []
    for name in ("LICENCE.txt", "LICENSE.txt", "LICENSE", "SOURCE.txt"):
        try:
            text = (folder / name).read_text(errors="replace")
        except OSError:
            continue
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        if name == "SOURCE.txt":
            lines = [line for line in lines if line.startswith("Origin")]
        licences.append(f"{name}: {' '.join(lines)[:1000]}")
    return tuple(licences)


def _supplied() -> dict[str, Path]:
    """Return the nets of the SUMO package by place name."""
    return _game_nets() | {name: one.path for name, one in WHEEL_PLACES.items()}


def _supplied_options(name: str) -> Options:
    """Return the import options of a place from the SUMO package."""
    one = WHEEL_PLACES.get(name)
    return Options() if one is None else Options(bbox=one.box)


@cache
def _game_nets() -> dict[str, Path]:
    """Return the SUMO package's nets with sidewalks by place name."""
    found: dict[str, Path] = {}
    for path in sorted((sumo_home() / "tools" / "game").glob("*/*.net.xml*")):
        data = path.read_bytes()
        if b'function="walkingarea"' in (gzip.decompress(data) if path.suffix == ".gz" else data):
            name = "sumo-" + path.parent.name.lower().replace("_", "-")
            found[name if name not in found else f"{name}-{map_name(path)}"] = path
    return found
