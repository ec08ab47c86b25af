"""A key of every family, with its text."""

from __future__ import annotations

from schemas import (
    CidKey,
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
    RejectKey,
    ResultKey,
    RpcKey,
    WithdrawalKey,
)
from tests.schemas.samples import LIGHTHOUSE, MODEL, SENDER
from tests.schemas.samples import LIGHTHOUSE_NAME as NAME
from tests.schemas.samples import NONCE as HASH

A = SENDER.lower()
L = LIGHTHOUSE.lower()

KEYS: list[tuple[Key, str]] = [
    (DemandKey(NAME, MODEL, HASH), f"aira/{NAME}/demand/{MODEL}/{HASH}"),
    (OfferKey(NAME, MODEL, HASH), f"aira/{NAME}/offer/{MODEL}/{HASH}"),
    (WithdrawalKey(NAME, HASH, HASH), f"aira/{NAME}/withdrawal/{HASH}/{HASH}"),
    (ResultKey(NAME, LIGHTHOUSE, HASH), f"aira/{NAME}/result/{L}/{HASH}"),
    (FeedbackKey(NAME, HASH, HASH), f"aira/{NAME}/feedback/{HASH}/{HASH}"),
    (PendingKey(NAME, HASH), f"aira/{NAME}/pending/{HASH}"),
    (RejectKey(NAME, HASH, SENDER), f"aira/{NAME}/reject/{HASH}/{A}"),
    (PresenceKey(NAME, "provider", SENDER), f"aira/{NAME}/@agent/provider/{A}"),
    (EventKey(SENDER, LIGHTHOUSE, "ready"), f"aira/agent/{A}/liability/{L}/ready"),
    (ObjectiveTopicKey(SENDER, LIGHTHOUSE, "/a/b"), f"aira/agent/{A}/liability/{L}/objective/a/b"),
    (LiabilityTopicKey(SENDER, LIGHTHOUSE, "/blink"), f"aira/agent/{A}/liability/{L}/topic/blink"),
    (DeviceTopicKey(SENDER, "tty-0", "/a/b"), f"aira/agent/{A}/device/tty-0/a/b"),
    (RpcKey(SENDER, "start"), f"aira/agent/{A}/rpc/start"),
    (RpcKey(SENDER, "eth/accounts"), f"aira/agent/{A}/rpc/eth/accounts"),
    (EthEventKey(SENDER, "transfer"), f"aira/agent/{A}/eth/event/transfer"),
    (CidKey(MODEL), f"aira/cid/{MODEL}"),
]
