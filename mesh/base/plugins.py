"""Entry points of installed packages, read directly from their `entry_points.txt`.

`importlib.metadata` does the same but imports parsers for mail, CSV and zip files: 3 MB and 30 ms, which an edge agent
does not have to spare. Packages inside zip files are not found here.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any, NamedTuple


class EntryPoint(NamedTuple):
    """An object that an installed package registers under a name: `value` is `module:attribute`."""

    name: str
    value: str
    package: str

    def load(self) -> Any:
        """Import the object. Raises what the import raises, or `AttributeError`."""
        module, _, attribute = self.value.partition(":")
        return getattr(import_module(module), attribute)


def entry_points(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group, by name. The first one on `sys.path` wins."""
    found: dict[str, EntryPoint] = {}
    for folder in sys.path:
        try:
            packages = sorted(name for name in os.listdir(folder or ".") if name.endswith((".dist-info", ".egg-info")))
        except OSError:  # not a folder, or not readable
            continue
        for package in packages:
            for entry in _read(os.path.join(folder, package, "entry_points.txt"), group, package):
                found.setdefault(entry.name, entry)
    return found


def _read(path: str, group: str, package: str) -> list[EntryPoint]:
    try:
        with open(path, encoding="utf-8") as file:
            lines = [line.strip() for line in file]
    except OSError:
        return []
    name, entries, section = package.partition("-")[0].replace("_", "-"), [], ""
    for line in lines:
        if line.startswith("["):
            section = line.strip("[]")
        elif section == group and "=" in line and not line.startswith(("#", ";")):
            key, _, value = line.partition("=")
            entries.append(EntryPoint(key.strip(), value.partition("[")[0].strip(), name))
    return entries
