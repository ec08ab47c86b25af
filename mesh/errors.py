"""What can go wrong while the mesh runs, by whose fault it is; the root and the input branch are `schemas.errors`."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Final

from schemas.errors import AiraError, InputError, InvalidAddress, InvalidCid, InvalidKey, InvalidMessage

if TYPE_CHECKING:
    from collections.abc import Iterable

LONGEST_PUBLIC: Final = 500
"""Characters of a text that leaves the process."""
HIDDEN: Final = "…"
_URL: Final = re.compile(r"\b([a-z][a-z0-9+.-]{1,30})://([^\s'\"<>|\\]*[^\s'\"<>|\\:.,;)]|)", re.IGNORECASE)
_HOST: Final = re.compile(r"(?:[^@/?#]*@)*((?:\[[0-9a-f:.]+\]|[^:/?#,@]*)(?::\d{1,5}(?!\d))?)", re.IGNORECASE)
_WINDOWS_PATH: Final = re.compile(r"(?:\b[A-Za-z]:\\|\\\\)[^\s'\"<>|]+")
_PATH: Final = re.compile(r"(?<![\w.…/-])~?/[^\s'\"<>|:;,)\]]+")


def public_text(error: BaseException | str, *, longest: int = LONGEST_PUBLIC) -> str:
    """What an error, or a text about one, may say outside this process: in messages, recordings, replies, status.

    URLs are cut to their hosts and ports, because providers of nodes put their customers' keys into the rest. Paths of
    this machine are hidden; topics and keys, which look like paths, stay. So do texts without either, up to `longest`
    characters.
    """
    if isinstance(error, BaseException):
        text = str(error) or type(error).__name__
        for value in vars(error).values():
            if isinstance(value, PurePath) and len(str(value)) > 1:
                text = text.replace(repr(str(value))[1:-1], HIDDEN).replace(str(value), HIDDEN)
    else:
        text = error
    if "://" in text:
        text = _URL.sub(lambda found: f"{found[1]}://{_host(found[2])}", text)
    if "\\" in text:
        text = _WINDOWS_PATH.sub(HIDDEN, text)
    if "/" in text:
        text = _PATH.sub(lambda found: HIDDEN if _is_of_this_machine(found[0]) else found[0], text)
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= longest else text[: longest - 1] + HIDDEN


def _host(rest: str) -> str:
    """The host in what follows `scheme://`."""
    found = _HOST.match(rest)
    return found[1] if found else HIDDEN


def _is_of_this_machine(path: str) -> bool:
    return path.startswith("~") or path.split("/")[1] in _top_folders()


@lru_cache(maxsize=1)
def _top_folders() -> frozenset[str]:
    """The names below this machine's root: what begins with one of them is a path, and no topic."""
    usual = {"home", "root", "tmp", "var", "etc", "usr", "opt", "mnt", "media", "srv", "run", "dev", "proc", "Users"}
    try:
        return frozenset(usual | {entry.name for entry in Path("/").iterdir()})
    except OSError:
        return frozenset(usual)


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that looks most like `name`; None if none is similar, as a wrong suggestion is worse than none."""
    import difflib  # here, as an edge agent must stay small and rarely needs it

    return next(iter(difflib.get_close_matches(name, known, n=1)), None)


class ConfigurationError(AiraError, code="configuration-error"):
    """The settings can't work as they are: an unknown option, a missing keyfile, a value out of range."""


class PortUnavailable(ConfigurationError, code="port-unavailable"):
    """A server can't listen on its port: it is taken, or this user may not have it."""

    def __init__(self, host: str, port: int, why: str, *, option: str = "--port") -> None:
        super().__init__(
            f"can't listen on {host}:{port}: {why}",
            hint=f"is another one running there? choose another with {option}; 0 selects a free one",
        )
        self.host = host
        self.port = port
        self.why = why


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
    "PortUnavailable",
    "RemoteError",
    "nearest",
    "public_text",
]
