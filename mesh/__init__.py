"""AIRA mesh: robots and people trade work without a middleman. Users import everything from here."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

from mesh.shadowing import require_own

require_own("schemas")  # before it is imported

from schemas.loading import on_demand  # noqa: E402

if TYPE_CHECKING:
    from mesh.agent import (
        Agent,
        Contract,
        Declined,
        Job,
        JobFailed,
        LiabilityReverted,
        Order,
        OrderClosed,
        OrderExpired,
        OrderState,
        Outcome,
        Phase,
        Progress,
    )
    from mesh.agent.answers import Answer, Unanswered
    from mesh.agent.offers import TooManyOffers
    from mesh.agent.own_model import ModelUnfit
    from mesh.agent.validators import AnnouncedValidator, ValidatorSilent
    from mesh.amounts import XRT
    from mesh.chain import InsufficientTokens, NodeUnreachable, NotALiability
    from mesh.chain.validators import UnsafeValidator
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
    from mesh.evidence import Finding
    from mesh.network import Reading
    from mesh.recording import Objective, Played, Recorder, RecordingAbout, open_objective, pack, pack_values
    from mesh.ros import RosTypes, UnknownRosType
    from mesh.running import fail, run_to_end, run_until_stopped
    from mesh.settings import Settings
    from mesh.validator.evidence import Evidence
    from mesh.validator.validator import Validator
    from mesh.work.objectives import ObjectiveNotFetched, ObjectiveUnfit
    from mesh.work.phases import WrongPhase
    from schemas import (
        STRING,
        ZERO_ADDRESS,
        Demand,
        Empty,
        InvalidPayload,
        Liability,
        Offer,
        Payload,
        PayloadType,
        Result,
        String,
        Verified,
        cid_of_file,
    )
    from schemas.model import InvalidDescription, ModelDescription, ModelLimits, ModelTopic
    from schemas.value_schema import ValueSchema
    from schemas.verdicts import PolicyNote, ReportFinding, ValidatorAnnouncement, ValidatorReport

    __version__: str

_NAMES: Final = {
    "mesh.agent.agent": "Agent",
    "mesh.agent.answers": "Answer Unanswered",
    "mesh.agent.contract": "Contract Outcome",
    "mesh.agent.errors": "Declined LiabilityReverted OrderClosed OrderExpired",
    "mesh.agent.offers": "TooManyOffers",
    "mesh.agent.own_model": "ModelUnfit",
    "mesh.agent.orders": "Order OrderState",
    "mesh.agent.progress": "Progress",
    "mesh.agent.validators": "AnnouncedValidator ValidatorSilent",
    "mesh.amounts": "XRT",
    "mesh.chain": "InsufficientTokens NodeUnreachable NotALiability",
    "mesh.chain.validators": "UnsafeValidator",
    "mesh.content": "ContentUnavailable",
    "mesh.errors": (
        "AiraError ChainError ClosedError ConfigurationError ContentError InputError NetworkUnavailable RemoteError"
    ),
    "mesh.evidence": "Finding",
    "mesh.network": "Reading",
    "mesh.recording": "Objective Played Recorder RecordingAbout open_objective pack pack_values",
    "mesh.ros": "RosTypes UnknownRosType",
    "mesh.running": "fail run_to_end run_until_stopped",
    "mesh.settings": "Settings",
    "mesh.validator.evidence": "Evidence",
    "mesh.validator.validator": "Validator",
    "mesh.work.job": "Job JobFailed",
    "mesh.work.phases": "Phase WrongPhase",
    "mesh.work.objectives": "ObjectiveNotFetched ObjectiveUnfit",
    "schemas": (
        "Demand Empty InvalidPayload Liability Offer Payload PayloadType Result STRING String Verified ZERO_ADDRESS"
        " cid_of_file"
    ),
    "schemas.model": "InvalidDescription ModelDescription ModelLimits ModelTopic",
    "schemas.value_schema": "ValueSchema",
    "schemas.verdicts": "PolicyNote ReportFinding ValidatorAnnouncement ValidatorReport",
}
_load = on_demand(__name__, _NAMES)


if not TYPE_CHECKING:  # a type checker knows the names from above, and reports others

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


__all__ = [
    "STRING",
    "XRT",
    "ZERO_ADDRESS",
    "Agent",
    "AiraError",
    "AnnouncedValidator",
    "Answer",
    "ChainError",
    "ClosedError",
    "ConfigurationError",
    "ContentError",
    "ContentUnavailable",
    "Contract",
    "Declined",
    "Demand",
    "Empty",
    "Evidence",
    "Finding",
    "InputError",
    "InsufficientTokens",
    "InvalidDescription",
    "InvalidPayload",
    "Job",
    "JobFailed",
    "Liability",
    "LiabilityReverted",
    "ModelDescription",
    "ModelLimits",
    "ModelTopic",
    "ModelUnfit",
    "NetworkUnavailable",
    "NodeUnreachable",
    "NotALiability",
    "Objective",
    "ObjectiveNotFetched",
    "ObjectiveUnfit",
    "Offer",
    "Order",
    "OrderClosed",
    "OrderExpired",
    "OrderState",
    "Outcome",
    "Payload",
    "PayloadType",
    "Phase",
    "Played",
    "PolicyNote",
    "Progress",
    "Reading",
    "Recorder",
    "RecordingAbout",
    "RemoteError",
    "ReportFinding",
    "Result",
    "RosTypes",
    "Settings",
    "String",
    "TooManyOffers",
    "Unanswered",
    "UnknownRosType",
    "UnsafeValidator",
    "Validator",
    "ValidatorAnnouncement",
    "ValidatorReport",
    "ValidatorSilent",
    "ValueSchema",
    "Verified",
    "WrongPhase",
    "__version__",
    "cid_of_file",
    "fail",
    "open_objective",
    "pack",
    "pack_values",
    "run_to_end",
    "run_until_stopped",
]
