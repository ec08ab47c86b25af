"""The door to IPFS: the legacy network's PubSub channel, and its content by CID."""

from bridges.ipfs.channel import ChannelBridge
from bridges.ipfs.daemon import Daemon
from bridges.ipfs.errors import (
    AccessDenied,
    DaemonRefused,
    DaemonUnreachable,
    IpfsError,
    JournalFailed,
    NoPeers,
    Overtaken,
    PubSubDisabled,
)
from bridges.ipfs.gate import Gate
from bridges.ipfs.journal import Journal
from bridges.ipfs.status import BridgeStatus, status_key

__all__ = [
    "AccessDenied",
    "BridgeStatus",
    "ChannelBridge",
    "Daemon",
    "DaemonRefused",
    "DaemonUnreachable",
    "Gate",
    "IpfsError",
    "Journal",
    "JournalFailed",
    "NoPeers",
    "Overtaken",
    "PubSubDisabled",
    "status_key",
]
