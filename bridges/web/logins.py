"""Who may do what: sessions of browsers that gave a token, and members of the site who show their certificate."""

from __future__ import annotations

import hmac
import logging
import secrets
import ssl
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web.answers import answer, body_of
from bridges.web.errors import LoginRequired, TooManyRequests
from bridges.web.options import is_loopback
from mesh.flood import BoundedDict, Rate, RateLimiter
from mesh.fresh_file import FreshFile
from mesh.identity.roster import read_roster
from mesh.log_context import log_event

if TYPE_CHECKING:
    from aiohttp import web

    from bridges.web.options import WebOptions
    from mesh.errors import AiraError
    from mesh.identity.roster import Member, Roster

log = logging.getLogger(__name__)

COOKIE: Final = "aira_session"
ATTEMPTS: Final = Rate(per_second=0.2, burst=10)
"""Attempts to log in, of one address."""
SESSIONS: Final = 1024
SESSION_SECONDS: Final = 12 * 3600.0


class LoginRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A token to log in with."""

    token: str


class Logins:
    """The sessions of one server, and the members of its roster, which may change at any time.

    Raises `RosterError` for a roster that can't be read at the start.
    """

    def __init__(self, options: WebOptions) -> None:
        self._options = options
        self._attempts = RateLimiter(per_sender=ATTEMPTS)
        self._sessions: BoundedDict[str, tuple[str, float]] = BoundedDict(SESSIONS)
        self._roster: FreshFile[Roster] | None = None
        if options.roster:
            self._roster = FreshFile(Path(options.roster).expanduser(), read_roster, on_error=_log_error)

    @property
    def is_needed(self) -> bool:
        """Whether the interface is for those only who logged in; else operators only log in."""
        return bool(self._options.token or self._options.roster) or not is_loopback(self._options.host)

    def role_of(self, request: web.Request) -> str | None:
        """What a request may do: `operator`, `anybody`, or None without a login."""
        role, until = self._sessions.get(request.cookies.get(COOKIE, ""), ("", 0.0))
        own = role if time.monotonic() < until else None
        member = self._member(request)
        if own == "operator" or member is None:
            return own
        return "operator" if "operator" in member.roles else "anybody"

    async def log_in(self, request: web.Request) -> web.Response:
        """Answer a token with a session. Raises `LoginRequired`, `TooManyRequests`."""
        if not self._attempts.allow(request.remote or ""):
            raise TooManyRequests("too many attempts to log in", hint="wait a minute")
        given = (await body_of(request, LoginRequest)).token.encode()
        roles = (("operator", self._options.operator_token), ("anybody", self._options.token))
        role = next((name for name, token in roles if token and hmac.compare_digest(token.encode(), given)), None)
        if role is None:
            raise LoginRequired("this is not the token")
        session = secrets.token_urlsafe(32)
        self._sessions[session] = role, time.monotonic() + SESSION_SECONDS
        response = answer({"role": role})
        secure = bool(self._options.certificate)
        response.set_cookie(
            COOKIE, session, max_age=int(SESSION_SECONDS), httponly=True, samesite="Strict", secure=secure
        )
        return response

    def tls(self) -> ssl.SSLContext | None:
        """How the server proves who it is, and which certificates of browsers it takes; None without TLS."""
        options = self._options
        if not options.certificate:
            return None
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(Path(options.certificate).expanduser(), Path(options.key).expanduser())
        if options.roster:
            context.load_verify_locations(Path(options.ca).expanduser())
            has_token = bool(options.token or options.operator_token)
            context.verify_mode = ssl.CERT_OPTIONAL if has_token else ssl.CERT_REQUIRED
        return context

    def _member(self, request: web.Request) -> Member | None:
        """The member of the roster whose certificate the browser showed, unless it is revoked."""
        certificate: Any = request.get_extra_info("peercert")
        if self._roster is None or not certificate:
            return None
        names = [value for part in certificate.get("subject", ()) for kind, value in part if kind == "commonName"]
        member = self._roster.content.find(names[0].lower()) if len(names) == 1 else None
        return None if member is None or member.revoked else member


def _log_error(error: AiraError) -> None:
    log.warning("the roster stays as it was: %s", error, extra=log_event("roster-unusable", code=error.code))
