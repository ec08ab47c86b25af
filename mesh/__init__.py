"""AIRA mesh: robots and people trade work without a middleman. Users import everything from here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas.loading import on_demand

if TYPE_CHECKING:
    from mesh.agent import (
        Agent,
        Contract,
        Job,
        JobFailed,
        LiabilityReverted,
        Order,
        OrderClosed,
        OrderExpired,
        OrderState,
        Outcome,
        Phase,
    )
    from mesh.chain import InsufficientTokens, NodeUnreachable, NotALiability
    from mesh.content import ContentUnavailable
    from mesh.errors import (
        AiraError,
        ChainError,
        ClosedError,
        ConfigurationError,
        ContentError,
        InputError,
        NetworkUnavailable,
        RemoteError,
    )
    from mesh.recording import Objective, Played, Recorder, RecordingAbout, open_objective, pack
    from mesh.running import fail, run_to_end
    from mesh.settings import Settings
    from mesh.work.ledger import WrongPhase
    from mesh.work.objectives import ObjectiveUnfit
    from schemas import (
        STRING,
        ZERO_ADDRESS,
        Demand,
        Empty,
        InvalidPayload,
        Liability,
        Offer,
        Result,
        String,
        Verified,
        cid_of_file,
    )

    __version__: str

_HOMES = {
    "Agent": "mesh.agent.agent",
    "AiraError": "mesh.errors",
    "ChainError": "mesh.errors",
    "ClosedError": "mesh.errors",
    "ConfigurationError": "mesh.errors",
    "ContentError": "mesh.errors",
    "ContentUnavailable": "mesh.content",
    "Contract": "mesh.agent.contract",
    "Demand": "schemas",
    "Empty": "schemas",
    "InputError": "mesh.errors",
    "InsufficientTokens": "mesh.chain",
    "InvalidPayload": "schemas",
    "Job": "mesh.work.job",
    "JobFailed": "mesh.work.job",
    "Liability": "schemas",
    "LiabilityReverted": "mesh.agent.errors",
    "NetworkUnavailable": "mesh.errors",
    "NodeUnreachable": "mesh.chain",
    "NotALiability": "mesh.chain",
    "Objective": "mesh.recording",
    "ObjectiveUnfit": "mesh.work.objectives",
    "Offer": "schemas",
    "Order": "mesh.agent.orders",
    "OrderClosed": "mesh.agent.errors",
    "OrderExpired": "mesh.agent.errors",
    "OrderState": "mesh.agent.orders",
    "Outcome": "mesh.agent.contract",
    "Phase": "mesh.work.ledger",
    "Played": "mesh.recording",
    "Recorder": "mesh.recording",
    "RecordingAbout": "mesh.recording",
    "RemoteError": "mesh.errors",
    "Result": "schemas",
    "STRING": "schemas",
    "Settings": "mesh.settings",
    "String": "schemas",
    "Verified": "schemas",
    "WrongPhase": "mesh.work.ledger",
    "ZERO_ADDRESS": "schemas",
    "cid_of_file": "schemas",
    "fail": "mesh.running",
    "open_objective": "mesh.recording",
    "pack": "mesh.recording",
    "run_to_end": "mesh.running",
}
_load = on_demand(__name__, _HOMES)


if not TYPE_CHECKING:  # a type checker knows the names from above, and reports others

    def __getattr__(name: str) -> Any:
        """Load a name on its first use: an edge agent must not load what it does not need."""
        return _version() if name == "__version__" else _load(name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("aira-mesh")
    except PackageNotFoundError:  # run from a source tree that was never installed
        return "0+unknown"


__all__ = [
    "STRING",
    "ZERO_ADDRESS",
    "Agent",
    "AiraError",
    "ChainError",
    "ClosedError",
    "ConfigurationError",
    "ContentError",
    "ContentUnavailable",
    "Contract",
    "Demand",
    "Empty",
    "InputError",
    "InsufficientTokens",
    "InvalidPayload",
    "Job",
    "JobFailed",
    "Liability",
    "LiabilityReverted",
    "NetworkUnavailable",
    "NodeUnreachable",
    "NotALiability",
    "Objective",
    "ObjectiveUnfit",
    "Offer",
    "Order",
    "OrderClosed",
    "OrderExpired",
    "OrderState",
    "Outcome",
    "Phase",
    "Played",
    "Recorder",
    "RecordingAbout",
    "RemoteError",
    "Result",
    "Settings",
    "String",
    "Verified",
    "WrongPhase",
    "__version__",
    "cid_of_file",
    "fail",
    "open_objective",
    "pack",
    "run_to_end",
]
