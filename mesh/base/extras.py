"""What need not be installed: the packages of extras, and what other packages register, which are entry points.

Entry points are read directly from `entry_points.txt`. `importlib.metadata` does the same but imports parsers for mail,
CSV and zip files: 3 MB and 30 ms, which an edge agent does not have to spare. Packages inside zip files are not found.
"""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator

RECURSION_LIMIT: Final = 3_000
"""Frames: safe on a stack of 2 MB (measured; 6,000 is not), and enough for contracts that call 200 deep."""


def install(extra: str) -> str:
    """How to install an extra: aira-mesh is in no registry of packages, so from its sources."""
    return f"in a clone of aira-mesh: pip install '.[{extra}]'"


class PackageMissing(ConfigurationError, ModuleNotFoundError, code="package-missing"):
    """An optional package is not installed. The hint names the extra that installs it."""

    def __init__(self, package: str, *, extra: str, user: str) -> None:
        super().__init__(f"{user} needs the package {package}, which is not installed", hint=install(extra))
        self.package = package
        self.extra = extra


@contextmanager
def needs_extra(extra: str, user: str) -> Iterator[None]:
    """Raise `PackageMissing` if an import in the body fails. `user` is what needs the package, as in "the chain".

    Of nested ones the outermost names the extra. Afterwards the interpreter's recursion limit is `RECURSION_LIMIT` at
    most: py_ecc raises it to 100,000, py-evm to 12,288, and then deeply nested JSON overflows the stack of a thread
    before it is refused, so that a single message could end the process.
    """
    try:
        yield
    except PackageMissing as error:
        raise PackageMissing(error.package, extra=extra, user=user) from None
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "mesh", "bridges", "schemas"):
            raise
        raise PackageMissing(package, extra=extra, user=user) from error
    finally:
        sys.setrecursionlimit(min(sys.getrecursionlimit(), RECURSION_LIMIT))


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
