"""Errors of the IPFS bridge."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, RemoteError

if TYPE_CHECKING:
    from pathlib import Path


class IpfsError(RemoteError, code="ipfs-error"):
    """An IPFS daemon or gateway failed or is unreachable; `api` is its address, `why` the cause."""

    def __init__(self, api: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"IPFS at {api}: {why}", hint=hint)
        self.api = api
        self.why = why


class DaemonUnreachable(IpfsError, code="daemon-unreachable"):
    """The daemon does not answer, or the connection broke; it may be back later."""

    def __init__(self, api: str, why: str) -> None:
        super().__init__(api, why, hint="is the daemon running, and is this the address of its RPC?")


class DaemonRefused(IpfsError, code="daemon-refused"):
    """The daemon answered a call with an error: `status` is the HTTP status, `why` the daemon's message."""

    def __init__(self, api: str, status: int, why: str, *, hint: str = "") -> None:
        super().__init__(api, why, hint=hint)
        self.status = status


class AccessDenied(DaemonRefused, code="access-denied"):
    """The daemon requires other credentials."""

    def __init__(self, api: str, status: int, why: str) -> None:
        super().__init__(
            api,
            status,
            why,
            hint="put the value of the Authorization header into a file and pass --ipfs-authorization-file; it must"
            " allow version, id, pubsub, swarm, add, block and pin below /api/v0/",
        )


class PubSubDisabled(DaemonRefused, code="pubsub-disabled"):
    """The daemon runs without PubSub."""

    def __init__(self, api: str, status: int, why: str) -> None:
        super().__init__(
            api, status, why, hint="ipfs config --json Pubsub.Enabled true; old ones: --enable-pubsub-experiment"
        )


class NoPeers(DaemonRefused, code="no-peers"):
    """The daemon knows no other subscriber of the topic. Keep the message and publish it later."""


class PublishedOutOfOrder(DaemonRefused, code="published-out-of-order"):
    """The daemon validated a later message of its own first and dropped this one as a replay. Publish it again."""


class JournalFailed(AiraError, code="journal-failed"):
    """A bridge can't read or write its journal."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            f"the journal {path} can't be used: {why}",
            hint="free some disk space; if the file is damaged, stop the bridge and delete it (some messages may then"
            " be relayed twice)",
        )
        self.path = path
        self.why = why
