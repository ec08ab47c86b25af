"""What can go wrong while the mesh runs, by whose fault it is; the root and the input branch are `schemas.errors`."""

from __future__ import annotations

from schemas.errors import AiraError, InputError, InvalidAddress, InvalidCid, InvalidKey, InvalidMessage


class ConfigurationError(AiraError):
    """The settings can't work as they are: an unknown option, a missing keyfile, a value out of range."""

    code = "configuration-error"


class RemoteError(AiraError):
    """The other side failed or is not there; trying again later may help."""

    code = "remote-error"


class NetworkUnavailable(RemoteError):
    """No Zenoh router answers at the configured endpoints."""

    code = "network-unavailable"

    def __init__(self, endpoints: tuple[str, ...], why: str) -> None:
        super().__init__(
            f"no Zenoh router at {', '.join(endpoints)} ({why})",
            hint="start one with `aira router`, or name another with --connect tcp/HOST:7447",
        )
        self.endpoints = endpoints


class ContentError(RemoteError):
    """A file behind a CID can't be had."""

    code = "content-error"


class ChainError(RemoteError):
    """The chain, or what runs on it, refused or did not answer."""

    code = "chain-error"


class ClosedError(AiraError):
    """An object was used after it was closed (by you; a broken world raises `RemoteError`)."""

    code = "closed-error"


__all__ = [
    "AiraError",
    "ChainError",
    "ClosedError",
    "ConfigurationError",
    "ContentError",
    "InputError",
    "InvalidAddress",
    "InvalidCid",
    "InvalidKey",
    "InvalidMessage",
    "NetworkUnavailable",
    "RemoteError",
]
