"""AIRA mesh: robots and people trade work without a middleman. Users import everything from here."""

from __future__ import annotations

from functools import cache
from typing import Any

from mesh.base.shadowing import require_own

require_own("schemas")  # before it is imported

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
