"""A process that fetches all tiles of a stored map as soon as a file appears, and prints which files it read from the store."""

import json
import sys
import time
from pathlib import Path
from typing import Any

from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.store.cache import TileCache
from service.maps.store.remote import Remote
from service.maps.store.stored_map import StoredMap


def main(url: str, folder: Path, begin: Path) -> None:
    names: list[str] = []
    save = Remote.save

    def counted(self: Remote, name: str, *arguments: Any, **named: Any) -> None:
        names.append(name)
        time.sleep(0.01)
        save(self, name, *arguments, **named)

    Remote.save = counted  # type: ignore[method-assign]
    found = StoredMap(url, TileCache(folder, 10**9))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while not begin.exists():
        time.sleep(0.001)
    found.refresh()
    (version,) = [each for each in found.folder.iterdir() if (each / "manifest.json").exists()]
    tiles = found.tiles(version)
    for tile in read_manifest(version).tiles:
        MapBundle.open(tiles.folder(tile))
    sys.stdout.write(json.dumps(names))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
