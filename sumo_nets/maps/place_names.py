"""Resolve a user's name of a place: a map's name, a folder of `city make` or `map import`, or a net
file.

The result can be stored in a scenario: a city by its seed or a map by its name, both with the hash
    of their net.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec

from cosim.core.errors import MapError, UsageError, unknown, unwritable
from cosim.core.files import atomic_folder
from cosim.spec.scenario import City, CityMap, Place
from sumo_nets.city.store import ABOUT_NAME, GENERATOR, NET_NAME, city_net
from sumo_nets.maps.import_rules import IMPORTER_VERSION
from sumo_nets.maps.map_store import (
    ABOUT,
    About,
    about_map,
    file_hash,
    import_map,
    known_maps,
    map_hash,
    map_name,
    maps_folder,
)
from sumo_nets.net.raw_file import net_content_hash

HINT = "the folder of `cosim city make` or of an imported map, or a .net.xml file"


class _MadeCity(msgspec.Struct):
    """Content of city.json."""

    city: City
    generator: int = 0


def resolve_place(name: str, roughness: float = 0.0) -> Place:
    """Return the place for a name or path; unknown nets are imported.

    roughness: of its ground, 0 to 1.

    Raises UsageError with the valid names, MapError when a file is unusable.
    """
    path = Path(name)
    found: Place = CityMap(map=name, roughness=roughness)
    if name in known_maps():
        return found
    if path.is_dir():
        found = _folder(path)
    elif path.exists():
        found = _file(path)
    else:
        error = unknown("map", name, known_maps())
        raise UsageError(f"{error} Or give a path: {HINT}.")
    return msgspec.structs.replace(found, roughness=roughness)


def _file(path: Path) -> Place:
    if path.name == NET_NAME and path.with_name(ABOUT_NAME).is_file():
        return _folder(path.parent)
    if path.name.endswith((".net.xml", ".net.xml.gz")) or path.name == "net.xml":
        return CityMap(map=imported_place(path))
    raise UsageError(
        f"{path}: cannot be run on as it is: import it first with `cosim map import {path}`"
    )


def _folder(folder: Path) -> Place:
    if (folder / ABOUT_NAME).is_file():
        return _city(folder)
    if (folder / ABOUT).is_file():
        return CityMap(map=_copied_into_store(folder))
    raise UsageError(
        f"{folder}: a folder without {ABOUT_NAME} or {ABOUT}, so neither one of `cosim city make` "
        f"nor an imported map; give {HINT}, or the name of a map (`cosim map list`)"
    )


def _city(folder: Path) -> Place:
    """Return the city in a folder, or a map if its net was changed or made by another version."""
    net, about = folder / NET_NAME, folder / ABOUT_NAME
    try:
        made = msgspec.json.decode(about.read_bytes(), type=_MadeCity)
    except (OSError, ValueError, msgspec.DecodeError) as error:
        raise MapError(f"{about}: cannot be read: {error}: make the city again") from error
    if made.generator == GENERATOR and net_content_hash(net) == made.city.net_hash:
        # Build the net from its seed: files of the folder must not enter the cache.
        with suppress(MapError):
            city_net(made.city)
            return made.city
    return CityMap(map=imported_place(net))


def imported_place(net: Path) -> str:
    """Return the name of a net file in the store of maps, and import it if it is missing."""
    source_hash, wanted = file_hash(net), map_name(net)
    name = _free_name(
        wanted,
        source_hash,
        lambda about: about.source_hash == source_hash and _has_default_options(about),
    )
    if not (maps_folder() / name).exists():
        import_map(net, name)
    return name


def _copied_into_store(folder: Path) -> str:
    """Copy an imported map from a folder into the store, and return its name there."""
    try:
        about = msgspec.json.decode((folder / ABOUT).read_bytes(), type=About)
    except (OSError, ValueError, msgspec.DecodeError) as error:
        raise MapError(
            f"{folder / ABOUT}: cannot be read: {error}: import the map again"
        ) from error
    if folder.resolve().parent == maps_folder().resolve():
        return folder.resolve().name
    found = map_hash(folder / "net.xml")
    if found != about.net_hash:
        raise MapError(
            f"{folder}: its hash is {found}, but {about.net_hash} when it was imported: it was "
            f"changed since; import the changed net with `cosim map import {folder / 'net.xml'}`"
        )
    name = _free_name(map_name(Path(about.name)), found, lambda known: known.net_hash == found)
    if not (maps_folder() / name).exists():
        try:
            with atomic_folder(maps_folder() / name, existing="keep") as ready:
                shutil.copytree(folder, ready, dirs_exist_ok=True)
                renamed = msgspec.structs.replace(about, name=name)
                (ready / ABOUT).write_bytes(
                    msgspec.json.format(msgspec.json.encode(renamed), indent=2)
                )
        except OSError as error:
            raise unwritable(maps_folder(), error, "set COSIM_CACHE to another folder") from error
    return name


def _free_name(wanted: str, content: str, is_same: Callable[[About], bool]) -> str:
    """Return the wanted name, with a part of the content's hash if another map has it."""
    names = known_maps()
    for name in (
        wanted,
        f"{wanted[:57]}-{content[:6]}",
        f"{wanted[:54]}-{content[:6]}-v{IMPORTER_VERSION}",
    ):
        if name not in names:
            return name
        with suppress(MapError):
            if names[name].origin == "imported" and is_same(about_map(name)):
                return name
    raise UsageError(
        f"two maps in the store are called '{wanted}': import it under another name with --name"
    )


def _has_default_options(about: About) -> bool:
    """Return whether a map was imported by this version without options."""
    plain = (
        about.bbox is None
        and about.lefthand is None
        and not about.as_is
        and about.sidewalk_width_m is None
    )
    return plain and about.versions.get("importer") == str(IMPORTER_VERSION)
