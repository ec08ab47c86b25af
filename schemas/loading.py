"""Packages that import a public name when it is first used, so that programs load only what they need (PEP 562).

The names of such a package, and the modules that have them, stand in its `__init__.pyi`, where type checkers read them.
"""

from __future__ import annotations

import os
import re
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

_IMPORT: Final = re.compile(r"^from (\S+) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)
_NAME: Final = re.compile(r"(\w+) as \1\b")


def on_demand(package: str) -> tuple[Callable[[str], Any], list[str]]:
    """A `__getattr__` for `package` (its `__name__`), which imports each name of its stub once; and these names."""
    module = sys.modules[package]
    with open(f"{os.path.dirname(module.__file__ or '')}/__init__.pyi", encoding="utf-8") as stub:
        imports = _IMPORT.finditer(stub.read())
    homes = {name[1]: found[1] for found in imports for name in _NAME.finditer(found[2] or found[3])}

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(module, name, value)
        return value

    return load, sorted(homes)
