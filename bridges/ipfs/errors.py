"""What can go wrong between the mesh and IPFS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, RemoteError

if TYPE_CHECKING:
    from pathlib import Path


class IpfsError(RemoteError):
    """An IPFS daemon or gateway failed or is not there; `api` is its address."""

    code = "ipfs-error"

    def __init__(self, api: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"IPFS at {api}: {why}", hint=hint)
        self.api = api
        self.why = why


class DaemonUnreachable(IpfsError):
    """The daemon does not answer, or broke off in the middle; it may be there again later."""

    code = "daemon-unreachable"

    def __init__(self, api: str, why: str) -> None:
        super().__init__(api, why, hint="is the daemon running, and is this the address of its RPC?")


class DaemonRefused(IpfsError):
    """The daemon answered a call with an error: `status` is HTTP's, `why` the daemon's own words."""

    code = "daemon-refused"

    def __init__(self, api: str, status: int, why: str, *, hint: str = "") -> None:
        super().__init__(api, why, hint=hint)
        self.status = status


class AccessDenied(DaemonRefused):
    """The daemon wants other credentials."""

    code = "access-denied"

    def __init__(self, api: str, status: int, why: str) -> None:
        super().__init__(
            api,
            status,
            why,
            hint="name a file with the value of the Authorization header (--ipfs-authorization-file); it must open"
            " version, id, pubsub, swarm, add, block and pin below /api/v0/",
        )


class PubSubDisabled(DaemonRefused):
    """The daemon runs without PubSub."""

    code = "pub-sub-disabled"

    def __init__(self, api: str, status: int, why: str) -> None:
        super().__init__(
            api, status, why, hint="ipfs config --json Pubsub.Enabled true; old ones: --enable-pubsub-experiment"
        )


class NoPeers(DaemonRefused):
    """Nobody whom the daemon knows listens to the topic. Keep the message and publish it later."""

    code = "no-peers"


class Overtaken(DaemonRefused):
    """The daemon has checked a later message of its own first, and so takes this one for a replay: publish it again."""

    code = "overtaken"


class JournalFailed(AiraError):
    """A bridge can't read or write what it must remember."""

    code = "journal-failed"

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            f"the journal {path} can't be used: {why}",
            hint="free some space; if it is damaged, stop the bridge and delete it: messages may then cross once more",
        )
        self.path = path
        self.why = why
