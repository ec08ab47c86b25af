"""What can go wrong between a session and its routers, beyond their not being there."""

from __future__ import annotations

from mesh.errors import RemoteError


class NotAdmitted(RemoteError):
    """A router is there, and it and this identity do not take each other."""

    code = "not-admitted"

    def __init__(self, *refusals: str) -> None:
        super().__init__(
            f"not let in by the Zenoh router at {'; '.join(refusals)}",
            hint="give --tls-ca, --tls-certificate and --tls-key of its site; `aira identity show` tells of them",
        )
