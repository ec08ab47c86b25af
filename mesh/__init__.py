"""AIRA mesh: robots and people trade work without a middleman."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas.loading import on_demand

if TYPE_CHECKING:
    from mesh.agent import Agent, Contract, JobFailed, Phase
    from mesh.settings import Settings

    __version__: str

_HOMES = {
    "Agent": "mesh.agent",
    "Contract": "mesh.agent",
    "JobFailed": "mesh.agent",
    "Phase": "mesh.agent",
    "Settings": "mesh.settings",
}
_load = on_demand(__name__, _HOMES)


def __getattr__(name: str) -> Any:
    """Load what is asked for: an edge agent must not pay for the parts that it does not use."""
    return _version() if name == "__version__" else _load(name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("aira-mesh")
    except PackageNotFoundError:  # run from a source tree that was never installed
        return "0+unknown"


__all__ = ["Agent", "Contract", "JobFailed", "Phase", "Settings", "__version__"]
