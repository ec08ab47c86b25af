"""Who plays in the matrix: members of a site and two who don't belong, the keys that each tries, and what each may.

The tables say by hand what `mesh.ops.identity.roster` says for Zenoh.
"""

from __future__ import annotations

from typing import Any

from mesh.ops.identity import Member
from schemas import (
    CidKey,
    CreatedKey,
    DeclineKey,
    DemandKey,
    DeviceTopicKey,
    EthEventKey,
    EventKey,
    FeedbackKey,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    OfferKey,
    PendingKey,
    PresenceKey,
    ProfileKey,
    ReadingKey,
    RejectKey,
    ReportKey,
    ResultKey,
    RpcKey,
    ValidatorKey,
    WithdrawalKey,
)
from tests.support.sites import MARKET

ADDRESSES = {
    name: "0x" + f"{number:02x}" * 20
    for number, name in enumerate(
        ("arm", "crane", "ann", "miner", "boss", "board", "bridge", "screen", "stranger", "gone", "witness", "judge"), 1
    )
}
MEMBERS = (
    Member(name="arm", address=ADDRESSES["arm"], roles=("agent",)),
    Member(name="ann", address=ADDRESSES["ann"], roles=("person",)),
    Member(name="miner", address=ADDRESSES["miner"], roles=("provider",)),
    Member(name="judge", address=ADDRESSES["judge"], roles=("validator",)),
    Member(name="boss", address=ADDRESSES["boss"], roles=("operator",)),
    Member(name="board", address=ADDRESSES["board"], roles=("edge",), agent=ADDRESSES["arm"]),
    Member(name="bridge", address=ADDRESSES["bridge"], roles=("bridge",)),
    Member(name="screen", address=ADDRESSES["screen"], roles=("watcher",)),
    Member(name="gone", address=ADDRESSES["gone"], roles=("agent", "provider"), revoked=True),
    Member(name="witness", address=ADDRESSES["witness"], roles=("router",)),
)
WHO = ("arm", "ann", "miner", "judge", "boss", "board", "bridge", "screen", "stranger", "gone")
"""The identities of the matrix. The stranger has a certificate of the site and is not in the roster."""

MODEL = "QmWATWQ7fVPP2EFGu71UkfnqhYXDYH566qy47CnJDgvs8u"
LIABILITY = "0x" + "ee" * 20
ORDERING = ("quote", "accept", "permit-fee", "pair", "stop")
"""The services by which a robot is chosen and stopped."""


def space(agent: str, device: str) -> dict[str, str]:
    """One key of each family below an agent."""
    return {
        "event": str(EventKey(agent, LIABILITY, "ready")),
        "objective": str(ObjectiveTopicKey(agent, LIABILITY, "/a/b")),
        "topic": str(LiabilityTopicKey(agent, LIABILITY, "/a/b")),
        "device": str(DeviceTopicKey(agent, device, "/a/b")),
        "reading": str(ReadingKey(agent, "/a/b")),
        "profile": str(ProfileKey(agent)),
        "rpc": str(RpcKey(agent, "eth/transfer")),
        **{service: str(RpcKey(agent, service)) for service in ORDERING},
        "eth": str(EthEventKey(agent, "transfer")),
        "cid": str(CidKey(agent, MODEL)),
    }


def keys_of(who: str) -> dict[str, str]:
    """A key of each family: the own ones, those of a robot that the board serves, and those of others."""
    own, other = ADDRESSES[who], ADDRESSES["crane"]
    roles = (
        "agent",
        "person",
        "provider",
        "validator",
        "operator",
        "edge",
        "bridge",
        "bridge-turn-0-00000000000000ff",
        "watcher",
    )
    keys: dict[str, Any] = {
        "demand": DemandKey(MARKET, MODEL),
        "offer": OfferKey(MARKET, MODEL),
        "withdrawal": WithdrawalKey(MARKET),
        "result": ResultKey(MARKET),
        "feedback": FeedbackKey(MARKET),
        "pending": PendingKey(MARKET),
        "created": CreatedKey(MARKET, MODEL),
        "reject": RejectKey(MARKET, own),
        "other reject": RejectKey(MARKET, other),
        "decline": DeclineKey(MARKET, own),
        "other decline": DeclineKey(MARKET, other),
        "report": ReportKey(MARKET, own),
        "other report": ReportKey(MARKET, other),
        "validator": ValidatorKey(MARKET, other),
        "other market": DemandKey("elsewhere.lighthouse.3.robonomics.eth", MODEL),
        "other presence": PresenceKey(MARKET, "agent", other),
        "nowhere": "aira/nowhere",
    }
    keys |= {f"as {role}": PresenceKey(MARKET, role, own) for role in roles}
    keys |= {f"own {name}": key for name, key in space(own, who).items()}
    keys |= {f"other {name}": key for name, key in space(other, who).items()}
    if who == "board":
        keys |= {f"robot {name}": key for name, key in space(ADDRESSES["arm"], who).items()}
        keys["robot's other device"] = DeviceTopicKey(ADDRESSES["arm"], "camera", "/a/b")
    return {name: str(key) for name, key in keys.items()}


KEYS = {who: keys_of(who) for who in WHO}
OWN = {f"own {name}" for name in space(ADDRESSES["arm"], "arm")}
OTHER = {
    "other event",
    "other objective",
    "other topic",
    "other device",
    "other reading",
    "other profile",
    "other rpc",
    *(f"other {service}" for service in ORDERING),
    "other eth",
    "other cid",
}
MARKETS = {"demand", "offer", "withdrawal", "result", "feedback", "pending", "reject", "other reject"} | {
    "created",
    "decline",
    "other decline",
    "report",
    "other report",
    "validator",
}
PRESENCES = {name for name in KEYS["arm"] if name.startswith("as ")} | {"other presence"}
NOBODY: dict[str, set[str]] = {who: set() for who in WHO}

PUT = NOBODY | {
    "arm": OWN | {"offer", "withdrawal", "result", "decline", "other decline"},
    "ann": OWN | {"demand", "withdrawal"},
    "miner": OWN | {"feedback", "pending", "created", "reject", "other reject"},
    "judge": OWN | {"result", "report", "other report"},
    "boss": OWN,
    "board": {"robot topic", "robot device"},
    "bridge": OWN | {"demand", "offer", "withdrawal", "result", "feedback", "pending"},
}
DELETE = NOBODY | dict.fromkeys(("arm", "ann", "miner", "judge", "boss", "bridge"), OWN)
SERVE = NOBODY | {
    "arm": OWN,
    "ann": OWN,
    "miner": OWN | MARKETS,
    "judge": OWN | {"report", "other report", "validator"},
    "boss": OWN,
    "board": {"robot topic", "robot device"},
    "bridge": OWN,
}
TOKEN = NOBODY | {
    "arm": OWN | {"as agent"},
    "ann": OWN | {"as agent", "as person"},
    "miner": OWN | {"as provider"},
    "judge": OWN | {"as validator"},
    "boss": OWN | {"as operator"},
    "board": {"robot device"},
    "bridge": OWN | {"as bridge", "as bridge-turn-0-00000000000000ff"},
}
GET = NOBODY | {
    "arm": OWN | MARKETS | {"other cid", "other profile"} | {f"other {service}" for service in ORDERING},
    "ann": OWN | MARKETS | {"other cid", "other profile"} | {f"other {service}" for service in ORDERING},
    "miner": OWN | MARKETS,
    "judge": OWN | MARKETS | {"other cid"},
    "boss": OWN | OTHER | MARKETS,
    "board": {"robot device", "robot event"},
    "bridge": OWN | MARKETS | {"other cid"},
    "screen": MARKETS | {"own cid", "other cid", "own profile", "other profile"},
}
SUBSCRIBE = NOBODY | {
    "arm": OWN | MARKETS | {"other reading", "other profile"},
    "ann": OWN | MARKETS | {"other reading", "other profile"},
    "miner": OWN | MARKETS,
    "judge": OWN | MARKETS,
    "boss": OWN | OTHER | MARKETS,
    "board": {"robot topic", "robot device", "robot event", "robot objective"},
    "bridge": OWN | MARKETS,
    "screen": OWN | OTHER | MARKETS,
}
PRESENCE = NOBODY | {
    "arm": OWN | PRESENCES,
    "ann": OWN | PRESENCES,
    "miner": OWN | PRESENCES,
    "judge": OWN | PRESENCES,
    "boss": OWN | OTHER | PRESENCES,
    "board": {"robot device"},
    "bridge": OWN | PRESENCES,
    "screen": OWN | OTHER | PRESENCES,
}
