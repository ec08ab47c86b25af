"""AIRA mesh: robots and people trade work without a middleman. Users import everything from here."""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib.util import find_spec
from typing import Any


def _require_own_schemas() -> None:
    """Raise `ImportError` if our package `schemas` is hidden by another one, which Python finds first.

    That may be a program's own, or one in the folder that a user works in. `python -m mesh` never needs what is in the
    current folder, so that is no longer searched for packages.
    """
    ours = os.path.dirname(os.path.dirname(__file__))
    folder = os.path.abspath(sys.path[0]) if sys.path else ours
    # Until Python has found `python -m mesh`, the name of the program is `-m`.
    is_run_as_module = sys.argv[:1] == ["-m"] and "-m mesh " in f"{' '.join(sys.orig_argv)} "
    if is_run_as_module and not sys.flags.safe_path and folder != ours:
        del sys.path[0]
    found = sys.modules["schemas"].__spec__ if "schemas" in sys.modules else find_spec("schemas")
    origin = (found and found.origin) or str(found and found.submodule_search_locations)
    if os.path.dirname(os.path.dirname(origin)) != ours:
        raise ImportError(
            f"aira-mesh needs its own package 'schemas', but Python finds {origin}: rename that, or move your program"
            " to another folder",
            name="schemas",
        )


_require_own_schemas()

from schemas.loading import on_demand  # noqa: E402

_load, _names = on_demand(__name__)
__all__ = [*_names, "__version__"]


def __getattr__(name: str) -> Any:
    """Load a name on its first use: an edge agent must not load what it does not need."""
    return _version() if name == "__version__" else _load(name)


@cache
def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("aira-mesh")
    except PackageNotFoundError:  # run from a source tree that was never installed
        return "0+unknown"
