"""This machine and its routers: its clock compared with others, the disk with its state, the address of each router,
the own certificate and a router's roster.

A wrong clock makes certificates look expired or not yet valid, and the times in recordings useless. Each address of a
router is checked separately, because a session uses the first that answers. The checks of the disk block.
"""

from __future__ import annotations

import errno
import os
import pwd
import shutil
import socket
import stat
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.network import Tls
from mesh.network.endpoints import SPARE_DESCRIPTORS, room_for_sessions
from mesh.network.locators import LOCATOR, WILDCARD_HOSTS, check_locators
from mesh.network.tls import TlsRefusal, shake_hands
from mesh.ops.doctor.checks import CheckResult, certificate_info, expiry_of, failed, passed, subject_values, warning
from mesh.ops.identity.roster import read_roster
from mesh.ops.identity.routers import router_endpoints

if TYPE_CHECKING:
    from mesh.ops.doctor.checks import DoctorContext
    from mesh.settings import Settings


DAY: Final = 86_400.0


class ClockLimits(NamedTuple):
    """How far clocks may be apart, in seconds."""

    apart: float = 5.0
    """Two clocks."""
    ahead: float = 30.0
    """A block in the future: development chains add a second per block, even if they are faster."""
    comparable: float = 120.0
    """For how long the time of a block can be compared with the clock."""


CLOCK_LIMITS: Final = ClockLimits()
CURE: Final = (
    "set the clock, preferably by NTP (timedatectl set-ntp true); the validity of certificates and the times in"
    " recordings depend on it"
)


class DiskLimits(NamedTuple):
    """What a disk must offer."""

    free: int = 100 << 20
    """Free bytes below which writing the ledger and recordings will soon fail."""
    slow: float = 1.0
    """Seconds for a small file above which a disk is too slow for a ledger that is synced at each step."""
    probe: int = 64 << 10
    """Bytes of that file."""


DISK_LIMITS: Final = DiskLimits()
FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN: Final = (errno.EACCES, errno.EPERM)


def compare_clock(theirs: float, ours: float, *, whose: str, tolerated: float = CLOCK_LIMITS.apart) -> CheckResult:
    """Compare somebody's clock with this one, both read at the same moment (seconds since the epoch)."""
    ahead = ours - theirs
    if abs(ahead) <= tolerated:
        return passed(f"differs by {abs(ahead):.1f} s from {whose} clock")
    apart = f"{duration(abs(ahead))} {'ahead of' if ahead > 0 else 'behind'}"
    return failed(f"this machine's clock is {apart} {whose} clock", code="clock-off", hint=CURE)


def compare_chain_clock(block_time: float, ours: float) -> CheckResult:
    """Compare the time of the newest block with this clock (seconds since the epoch)."""
    age = ours - block_time
    if age < -CLOCK_LIMITS.ahead:
        return failed(
            f"this machine's clock is {duration(-age)} behind the newest block", code="clock-behind", hint=CURE
        )
    if age > CLOCK_LIMITS.comparable:
        return passed(f"the newest block is {duration(age)} old, too old to compare clocks", code="block-too-old")
    return passed(f"agrees with the newest block, {'0 s' if age < 1 else duration(age)} old")


def duration(seconds: float) -> str:
    """A duration in the most readable unit."""
    for name, length in (("days", DAY), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {name}"
    return f"{seconds:.0f} s"


def check_data_folder(folder: Path, *, slow: float = DISK_LIMITS.slow) -> CheckResult:
    """Whether a file can be written and synced in the state's folder, or where that will be created.

    Taking more than `slow` seconds is a warning.
    """
    existing = _nearest(folder)
    began = time.monotonic()
    try:
        with tempfile.TemporaryFile(dir=existing) as probe:
            probe.write(bytes(DISK_LIMITS.probe))
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        return _write_failure(folder, existing, error)
    took = time.monotonic() - began
    if took > slow:
        return warning(
            f"{existing} takes {took:.1f} s to write and sync a small file",
            code="disk-slow",
            hint="use a local disk for --data-dir; each step of a job waits for the disk",
        )
    if existing != folder:
        return passed(f"{folder} will be created on start; {existing} is writable", code="folder-missing")
    return passed(f"{folder} is writable (a file was synced in {took * 1000:.0f} ms) and belongs to {_owner(folder)}")


def check_disk_space(folder: Path, *, content_limit: int, least: int = DISK_LIMITS.free) -> CheckResult:
    """Whether at least `least` bytes are free, and the store has room to grow to `content_limit` bytes."""
    free = shutil.disk_usage(_nearest(folder)).free
    kept = sum(map(_size, folder.glob("*/content/*")))
    shown = f"{_gigabytes(free)} free, content uses {_gigabytes(kept)} of at most {_gigabytes(content_limit)}"
    if free < least:
        return failed(
            f"{shown} in {folder}", code="disk-space", hint="free some space, or use another disk with --data-dir"
        )
    if free + kept < content_limit:
        return warning(shown, code="disk-space", hint="reduce --content-limit, or free some space")
    return passed(shown)


def check_descriptors(max_sessions: int) -> CheckResult:
    """Whether a router started like this process may open a file descriptor for each of `max_sessions`."""
    room = room_for_sessions()
    if room >= max_sessions:
        return passed(f"there are file descriptors for {max_sessions:,} sessions")
    return warning(
        f"there are file descriptors for {room:,} sessions, not for {max_sessions:,}",
        code="few-descriptors",
        hint=f"raise the hard limit of open files to {max_sessions + SPARE_DESCRIPTORS} (LimitNOFILE in a systemd unit,"
        f" or ulimit -Hn), or give the router --max-sessions {room}",
    )


def _write_failure(folder: Path, existing: Path, error: OSError) -> CheckResult:
    """Why no file can be written in `existing`: the folder, or the one in which it will be created."""
    if error.errno in FULL:
        return failed(
            f"the disk of {existing} is full: {error.strerror}",
            code="disk-full",
            hint="free some space there, or use another disk with --data-dir",
        )
    other = "use another folder with --data-dir"
    if error.errno not in FORBIDDEN:
        return failed(f"{existing} is not writable: {error.strerror}", code="not-writable", hint=other)
    user = os.geteuid()
    # A folder above may belong to the system: don't suggest changing its owner.
    own = f"sudo chown -R {user} {folder}" if existing == folder else f"sudo install -d -o {user} {folder}"
    return failed(
        f"{existing} is not writable: {error.strerror}; it belongs to {_owner(existing)}, not to {_user(user)}",
        code="not-writable",
        hint=f"{own}, or {other}",
    )


def _nearest(folder: Path) -> Path:
    """The folder, or the nearest existing one above it that this user can see."""
    return next(path for path in (folder, *folder.absolute().parents) if os.path.exists(path))


def _size(path: Path) -> int:
    """Bytes of a file; 0 if it was deleted meanwhile or this user can't see it."""
    try:
        about = path.stat()
    except OSError:
        return 0
    return about.st_size if stat.S_ISREG(about.st_mode) else 0


def _owner(path: Path) -> str:
    try:
        return _user(path.stat().st_uid)
    except OSError:
        return "an unknown user"


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"the user {number}"


def _gigabytes(size: int) -> str:
    return f"{size / 1024**3:,.1f} GiB"


ROUTER_SECONDS: Final = 3.0
"""Seconds after which a router that has not answered counts as dead."""
LOOPBACK: Final = dict(zip(WILDCARD_HOSTS, ("127.0.0.1", "::1"), strict=True))
"""The address at which this machine reaches a router that listens on all addresses."""
OWN_FILES: Final = (
    "give --tls-ca, --tls-certificate and --tls-key of the router's site; `aira identity show` describes a certificate"
)


def check_router_address(locator: str, settings: Settings) -> CheckResult:
    """Whether a router answers at its address, and whether both accept each other's certificates.

    Raises `ConfigurationError` for a malformed address.
    """
    check_locators(locator)
    place = LOCATOR.fullmatch(locator)
    if place is None or place["protocol"] not in ("tcp", "tls"):
        return passed(f"{locator} can't be checked without a session; see the session check", code="not-checked")
    host, port = place["six"] or place["host"], int(place["port"])
    host = LOOPBACK.get(host, host)
    try:
        socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (socket.gaierror, UnicodeError):
        return failed(
            f"{locator}: can't resolve the name {host}",
            code="unresolvable",
            hint="check its spelling and this machine's DNS settings, or use the router's IP address",
        )
    began = time.monotonic()
    try:
        with socket.create_connection((host, port), ROUTER_SECONDS):
            pass
    except OSError as error:
        return _unanswered(locator, error)
    answers = f"{locator} answers in {(time.monotonic() - began) * 1000:.1f} ms"
    if place["protocol"] == "tcp":
        return passed(answers)
    return _shown(locator, Tls.from_settings(settings), answers)


def is_everywhere(locator: str) -> bool:
    """Whether a router listens on all addresses, so that its certificate does not name this locator."""
    place = LOCATOR.fullmatch(locator)
    return place is not None and place["protocol"] == "tls" and (place["six"] or place["host"]) in WILDCARD_HOSTS


def check_certificate(context: DoctorContext) -> CheckResult:
    """Whether the own certificate can be used, and for how long. Raises `ConfigurationError` if it can't."""
    tls = Tls.from_settings(context.settings)
    if tls is None:
        return failed(
            "a tls/ endpoint needs the site's certificate, but none is set", code="no-certificate", hint=OWN_FILES
        )
    own = certificate_info(tls, mode="router" if context.role == "router" else "client")
    if own is None:
        return warning(
            "the site's certificate is set, but no certificate of our own",
            code="no-own-certificate",
            hint="ask the site's operator for a certificate, then " + OWN_FILES,
        )
    whose = f"{own.name or 'no name'}, {', '.join(own.roles) or 'no role'}, {own.address}"
    return _lasting(f"{whose}: valid", own.until, whose="own")


def check_roster(context: DoctorContext) -> CheckResult:
    """Whether the router's settings and roster can be used. Raises `ConfigurationError`."""
    router_endpoints(context.settings)
    if not context.settings.roster:
        return passed("none: the router listens on loopback only, and every client may do everything", code="no-roster")
    roster = read_roster(Path(context.settings.roster).expanduser())
    admitted = roster.admitted()
    if not admitted:
        return failed(
            f"{context.settings.roster} admits no member",
            code="no-members",
            hint="add one with `aira identity new FOLDER --site SITE --role ROLE --roster FILE`",
        )
    own = context.identity.address if context.identity is not None else ""
    if own and context.settings.link and own not in {member.address for member in admitted}:
        return failed(
            f"{own} is not in {context.settings.roster}, so the routers that this one links to deny all its operations",
            code="not-in-roster",
            hint="add it with the role router, there and to the rosters of those routers",
        )
    revoked = len(roster.member) - len(admitted)
    members = f"{len(admitted)} member{'' if len(admitted) == 1 else 's'}, {revoked or 'none'} revoked"
    return passed(f"{members}, markets {', '.join(roster.lighthouses)}")


def _unanswered(locator: str, error: OSError) -> CheckResult:
    if isinstance(error, ConnectionRefusedError):
        return failed(
            f"{locator}: no router listens there",
            code="no-router",
            hint="start one with `aira router`, or give another address with --connect tcp/HOST:PORT",
        )
    why = f"no answer within {ROUTER_SECONDS:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
    return failed(
        f"{locator}: {why}",
        code="no-answer",
        hint="check that the machine is on and reachable, and that its firewall allows the port",
    )


def _shown(locator: str, tls: Tls | None, answers: str) -> CheckResult:
    """The certificate that a TLS router presents, and whether it accepts ours."""
    if tls is None:
        return failed(
            f"{locator}: the router requires a certificate, but none is set",
            code="certificate-required",
            hint=OWN_FILES,
        )
    certificate = shake_hands(tls, locator, ROUTER_SECONDS)
    if isinstance(certificate, TlsRefusal):
        return failed(
            f"{locator}: {certificate.text}",
            code=certificate.reason,
            hint=f"check that {tls.ca} is of this router's site; {OWN_FILES}",
        )
    if certificate is None:
        return failed(
            f"{locator}: the TLS 1.3 handshake failed",
            code="handshake-failed",
            hint="check that this is the router's port, and that the router runs with --listen tls/HOST:PORT",
        )
    whose = next(
        iter(subject_values(certificate, "organizationName") + subject_values(certificate, "commonName")),
        "an unnamed holder",
    )
    shown = f"{answers}, accepts our certificate and presents that of {whose}"
    return _lasting(shown, expiry_of(certificate), whose="router")


def _lasting(words: str, until: float, *, whose: str) -> CheckResult:
    """The result for a certificate that expires then (seconds since the epoch)."""
    left = until - time.time()
    shown = f"{duration(left)} left" if left > 0 else "expired"
    day = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(until))
    if left > 7 * DAY:
        return passed(f"{words}, until {day} ({shown})")
    renew = "`aira identity renew FOLDER --site SITE` where the site's key is; open sessions switch automatically"
    return warning(
        f"{words}, but only until {day} ({shown})",
        code="certificate-expires",
        hint=f"renew the {whose} certificate: {renew}",
    )
