"""A key of every family, with its text."""

from __future__ import annotations

from schemas import (
    CidKey,
    CreatedKey,
    DeclineKey,
    DemandKey,
    DeviceTopicKey,
    EthEventKey,
    EventKey,
    FeedbackKey,
    Key,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    OfferKey,
    PendingKey,
    PresenceKey,
    ProfileKey,
    ProgressKey,
    ReadingKey,
    RejectKey,
    ReportKey,
    ResultKey,
    RpcKey,
    ValidatorKey,
    WithdrawalKey,
)
from tests.support.schemas.samples import LIGHTHOUSE, MODEL, SENDER
from tests.support.schemas.samples import LIGHTHOUSE_NAME as NAME

A = SENDER.lower()
L = LIGHTHOUSE.lower()

KEYS: list[tuple[Key, str]] = [
    (DemandKey(NAME, MODEL), f"aira/{NAME}/demand/{MODEL}"),
    (OfferKey(NAME, MODEL), f"aira/{NAME}/offer/{MODEL}"),
    (WithdrawalKey(NAME), f"aira/{NAME}/withdrawal"),
    (ResultKey(NAME), f"aira/{NAME}/result"),
    (FeedbackKey(NAME), f"aira/{NAME}/feedback"),
    (PendingKey(NAME), f"aira/{NAME}/pending"),
    (CreatedKey(NAME, MODEL), f"aira/{NAME}/created/{MODEL}"),
    (RejectKey(NAME, SENDER), f"aira/{NAME}/reject/{A}"),
    (DeclineKey(NAME, SENDER), f"aira/{NAME}/decline/{A}"),
    (PresenceKey(NAME, "provider", SENDER), f"aira/{NAME}/@agent/provider/{A}"),
    (ProgressKey(SENDER, LIGHTHOUSE), f"aira/agent/{A}/liability/{L}/progress"),
    (EventKey(SENDER, LIGHTHOUSE, "ready"), f"aira/agent/{A}/liability/{L}/ready"),
    (ObjectiveTopicKey(SENDER, LIGHTHOUSE, "/a/b"), f"aira/agent/{A}/liability/{L}/objective/a/b"),
    (LiabilityTopicKey(SENDER, LIGHTHOUSE, "/blink"), f"aira/agent/{A}/liability/{L}/topic/blink"),
    (DeviceTopicKey(SENDER, "tty-0", "/a/b"), f"aira/agent/{A}/device/tty-0/a/b"),
    (ReadingKey(SENDER, "/battery"), f"aira/agent/{A}/reading/battery"),
    (ProfileKey(SENDER), f"aira/agent/{A}/profile"),
    (RpcKey(SENDER, "start"), f"aira/agent/{A}/rpc/start"),
    (RpcKey(SENDER, "eth/accounts"), f"aira/agent/{A}/rpc/eth/accounts"),
    (EthEventKey(SENDER, "transfer"), f"aira/agent/{A}/eth/event/transfer"),
    (CidKey(SENDER, MODEL), f"aira/agent/{A}/cid/{MODEL}"),
    (ReportKey(NAME, SENDER), f"aira/{NAME}/report/{A}"),
    (ValidatorKey(NAME, SENDER), f"aira/{NAME}/validator/{A}"),
]
