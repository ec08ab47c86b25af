"""Who is shut out: signers or sessions, in files that an operator may change at any time."""

from __future__ import annotations

import logging
import re
import threading
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from mesh.clock import SYSTEM_CLOCK
from mesh.errors import ConfigurationError
from mesh.log_context import log_event
from schemas import InputError, parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.clock import Clock
    from mesh.network.connections import Connection

log = logging.getLogger(__name__)

CHECK_INTERVAL: Final = 1.0
"""Seconds between two looks at whether the file has changed."""
SIZE_LIMIT: Final = 4 * 1024 * 1024
"""The largest file, in bytes: about 90,000 addresses."""
SESSION: Final = re.compile(r"[0-9a-f]{1,32}")
"""A Zenoh id."""


class BlocklistUnusable(ConfigurationError, code="blocklist-unusable"):
    """The file of blocked signers or sessions can't be read, is too large, or has a line that names none."""


class BlockedSigners(Protocol):
    """Which signers are blocked."""

    def __contains__(self, signer: object) -> bool: ...


class Blocklist:
    """The lines of the file `path`, each as `parse` writes it; `#` begins a comment.

    By default they are addresses, and `"0x…" in blocklist` (EIP-55) asks for one. The file is read again within a
    second of a change. A change that can't be read is logged, and those from before stay blocked. Thread-safe. Raises
    `BlocklistUnusable` when it is created from such a file.
    """

    def __init__(self, path: Path, *, parse: Callable[[str], str] = parse_address, clock: Clock = SYSTEM_CLOCK) -> None:
        self._path = path
        self._parse = parse
        self._clock = clock
        self._lock = threading.Lock()
        self._version = self._stat()
        self._entries = self._read()
        self._checked = clock.monotonic()

    def __contains__(self, entry: object) -> bool:
        return entry in self.entries

    @property
    def entries(self) -> frozenset[str]:
        """All of them; the same object as long as nothing has changed."""
        if self._clock.monotonic() - self._checked >= CHECK_INTERVAL:
            self._check()
        return self._entries

    def _check(self) -> None:
        with self._lock:
            self._checked = self._clock.monotonic()
            try:
                version = self._stat()
                if version == self._version:
                    return
                self._version = version
                self._entries = self._read()
            except BlocklistUnusable as error:
                log.warning("the blocklist stays as it was: %s", error, extra=log_event("blocklist-unusable"))
            else:
                facts = log_event("blocklist-read", blocked=len(self._entries), path=str(self._path))
                log.info("%d are blocked by %s", len(self._entries), self._path, extra=facts)

    def _stat(self) -> tuple[int, int, int] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None  # reading it says why
        return found.st_mtime_ns, found.st_size, found.st_ino

    def _read(self) -> frozenset[str]:
        try:
            with self._path.open("rb") as file:
                data = file.read(SIZE_LIMIT + 1)
            lines = data.decode().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not text"
            raise BlocklistUnusable(
                f"can't read the blocklist {self._path}: {reason}", hint="name a file, which may be empty"
            ) from None
        if len(data) > SIZE_LIMIT:
            raise BlocklistUnusable(f"the blocklist {self._path} is larger than {SIZE_LIMIT} bytes")
        return frozenset(filter(None, map(self._entry, range(1, len(lines) + 1), lines)))

    def _entry(self, number: int, line: str) -> str:
        text = line.partition("#")[0].strip()
        try:
            return self._parse(text) if text else ""
        except (InputError, ValueError) as error:
            raise BlocklistUnusable(
                f"line {number} of the blocklist {self._path} can't be used: {error}", hint="write one entry a line"
            ) from None


def blocklist_at(path: str) -> BlockedSigners:
    """The blocklist in the file that a setting names; nobody is blocked if it is empty. Raises `BlocklistUnusable`."""
    return Blocklist(Path(path).expanduser()) if path else frozenset()


class BlockedSessions:
    """The sessions that the file `path` blocks.

    A line is a Zenoh id, the address in a certificate, or the IP address or network (`192.0.2.0/24`) that sessions come
    from. Raises `BlocklistUnusable`.
    """

    def __init__(self, path: Path, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._list = Blocklist(path, parse=parse_session, clock=clock)
        self._read: frozenset[str] = frozenset()
        self._networks: list[IPv4Network | IPv6Network] = []

    def changed(self) -> bool:
        """Read the file if it is time; whether it has changed since the last call."""
        before, self._read = self._read, self._list.entries
        if self._read is not before:
            self._networks = [ip_network(entry) for entry in self._read if "/" in entry]
        return self._read != before

    def __contains__(self, connection: Connection) -> bool:
        address = ip_address(connection.host)
        if isinstance(address, IPv6Address):
            address = address.ipv4_mapped or address
        names = {connection.session, connection.name.lower(), str(address)}
        return not self._read.isdisjoint(names) or any(address in network for network in self._networks)


def parse_session(text: str) -> str:
    """What names sessions, as it is compared. Raises `InputError` and `ValueError`."""
    text = text.lower()
    if text.startswith("0x"):
        return parse_address(text).lower()
    if SESSION.fullmatch(text):
        return text
    network = ip_network(text, strict=False)
    return str(network) if network.num_addresses > 1 else str(network.network_address)


def blocked_sessions_at(path: str) -> BlockedSessions | None:
    """The sessions that the file blocks that a setting names; None if it is empty. Raises `BlocklistUnusable`."""
    return BlockedSessions(Path(path).expanduser()) if path else None
