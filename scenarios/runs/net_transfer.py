"""Transfer of imported maps from the coordinator to workers, by the hash of their street net.

Each worker builds generated cities and places of SUMO itself. Every net is compared with the
coordinator's hash before an episode runs on it.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Final

import msgspec

from bridge.codec import decode, encode
from cosim.core.errors import EngineError, unwritable
from cosim.core.files import atomic_folder
from cosim.place.scan import SCAN_FOLDER
from cosim.spec.scenario import CityMap, Place
from scenarios.places.nets import place
from scenarios.runs.protocol import NetPart
from sumo_nets.maps.feature_file import FEATURES_FILE
from sumo_nets.maps.ground_file import GROUND_FILE
from sumo_nets.maps.map_store import (
    ABOUT,
    MAP_NAME_PATTERN,
    known_maps,
    map_hash,
    map_net,
    maps_folder,
)

_PART_BYTES: Final = 2 << 20
"""Size in bytes of a part of a map."""
_MAX_BYTES: Final = 1 << 30
"""Size limit in bytes of a map, packed and unpacked."""
_NET: Final = "net.xml"
_FILES: Final = (_NET, ABOUT, FEATURES_FILE, GROUND_FILE)
_SCAN_FILE: Final = re.compile(SCAN_FOLDER + r"/[a-z0-9-]+\.[a-z0-9]+", re.ASCII)
"""Pattern of the files of a scan, as they are sent."""


def is_imported(where: Place) -> bool:
    """Return whether a place is an imported map."""
    if not isinstance(where, CityMap):
        return False
    known = known_maps().get(where.map)
    return known is None or known.origin == "imported"


def is_missing(where: Place) -> bool:
    """Return whether a place is a map that this machine lacks."""
    return isinstance(where, CityMap) and where.map not in known_maps()


class RunMaps:
    """The maps of a run, as the coordinator sends them."""

    def __init__(self) -> None:
        self._hashes: dict[Place, str] = {}
        self._packed: dict[str, bytes] = {}
        self._maps: dict[str, CityMap] = {}

    def hash_of(self, where: Place) -> str:
        """Return the hash of a place's street net."""
        if where not in self._hashes:
            self._hashes[where] = where.net_hash or place(where)[1].net_hash
        if isinstance(where, CityMap):
            self._maps[self._hashes[where]] = where
        return self._hashes[where]

    def packed(self, digest: str) -> bytes:
        """Return a map as it is sent. Raises EngineError for one that is not of this run."""
        where = self._maps.get(digest)
        if where is None or not is_imported(where):
            raise EngineError(f"this run has no map '{digest}' to hand out")
        if digest not in self._packed:
            folder = map_net(where).parent
            files = {name: (folder / name).read_bytes() for name in _files_in(folder)}
            self._packed[digest] = zlib.compress(msgspec.msgpack.encode(files), 1)
        return self._packed[digest]

    def part(self, digest: str, payload: bytes) -> bytes:
        """Reply to the request for a part of a map. Raises EngineError for one that is not of this
        run."""
        packed = self.packed(digest)
        begin = decode(payload, NetPart).begin
        return encode(NetPart(begin, len(packed), packed[begin : begin + _PART_BYTES]))


def _files_in(folder: Path) -> list[str]:
    """Return the names of the files of a map that are sent."""
    scan = sorted(f"{SCAN_FOLDER}/{path.name}" for path in (folder / SCAN_FOLDER).glob("*.*"))
    names = [*_FILES, *(name for name in scan if _SCAN_FILE.fullmatch(name))]
    return [name for name in names if (folder / name).is_file()]


class MapDownload:
    """Download of a map by a worker."""

    def __init__(self, where: CityMap, digest: str) -> None:
        self._where = where
        self.digest = digest
        self._packed = bytearray()

    @property
    def request(self) -> bytes:
        """Return the request for the next part."""
        return encode(NetPart(len(self._packed)))

    def take(self, payload: bytes) -> bool:
        """Take in a part. Returns whether it was the last one: then the map is stored here, under
        its name.

        Raises MachineError when it cannot be stored, EngineError when it is not the requested one.
        """
        part = decode(payload, NetPart)
        if part.whole > _MAX_BYTES:
            raise EngineError(
                f"map '{self._where.map}' of {part.whole >> 20} MB is more than is taken"
            )
        if part.begin == len(self._packed):
            self._packed += part.data
        if len(self._packed) < part.whole:
            return False
        self.keep(bytes(self._packed))
        return True

    def keep(self, packed: bytes) -> None:
        """Store the map, sent as a whole, under its name. Raises as `take` does."""
        name = self._where.map
        folder = maps_folder()
        try:
            opened = zlib.decompressobj()
            files = decode(opened.decompress(packed, _MAX_BYTES), dict[str, bytes])
        except zlib.error as error:
            raise EngineError(f"map '{name}' was damaged on its way: {error}") from error
        known = all(name in _FILES or _SCAN_FILE.fullmatch(name) for name in files)
        if not (MAP_NAME_PATTERN.fullmatch(name) and known and {_NET, ABOUT} <= files.keys()):
            raise EngineError(f"what came as map '{name}' is none")
        try:
            with atomic_folder(folder / name, existing="keep") as ready:
                for file, data in files.items():
                    (ready / file).parent.mkdir(exist_ok=True)
                    (ready / file).write_bytes(data)
                if (found := map_hash(ready / _NET)) != self.digest:
                    raise EngineError(
                        f"map '{name}' came with hash {found} in place of {self.digest}"
                    )
        except OSError as error:
            raise unwritable(folder, error, "set COSIM_CACHE to another folder") from error
