"""What can go wrong while the mesh runs, by whose fault it is; the root and the input branch are `schemas.errors`."""

from __future__ import annotations

from schemas.errors import AiraError, InputError, InvalidAddress, InvalidCid, InvalidKey, InvalidMessage


class ConfigurationError(AiraError, code="configuration-error"):
    """The settings can't work as they are: an unknown option, a missing keyfile, a value out of range."""


class RemoteError(AiraError, code="remote-error"):
    """The other side failed or is not there; trying again later may help."""


class NetworkUnavailable(RemoteError, code="network-unavailable"):
    """No Zenoh router answers at the configured endpoints."""

    def __init__(self, endpoints: tuple[str, ...], why: str) -> None:
        super().__init__(
            f"no Zenoh router at {', '.join(endpoints)} ({why})",
            hint="start one with `aira router`, or name another with --connect tcp/HOST:7447",
        )
        self.endpoints = endpoints


class ContentError(RemoteError, code="content-error"):
    """A file behind a CID can't be had."""


class ChainError(RemoteError, code="chain-error"):
    """The chain, or what runs on it, refused or did not answer."""


class ClosedError(AiraError, code="closed-error"):
    """An object was used after it was closed (by you; a broken world raises `RemoteError`)."""


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
