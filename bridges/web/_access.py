"""Who may use the page, and in what form: options, logins, reading requests, answers, errors with their HTTP status.

A browser has a session after it gave a token; members of the site show their certificate instead.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import ssl
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, TypeVar

import msgspec
from aiohttp import web

from bridges.serving import ServerOptions, is_loopback
from mesh.base.flood import BoundedDict
from mesh.base.fresh_file import FreshFile
from mesh.base.log_context import log_event
from mesh.errors import AiraError, ConfigurationError, InputError
from mesh.ops.identity.roster import read_roster
from schemas import parse_address, parse_cid
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from mesh.ops.identity.roster import Member, Roster


class WebError(AiraError, code="invalid-request"):
    """A request can't be served: its body, path or query is not what the interface says; or its code says why.

    `reason` is a word for programs, as in rejections, of an order that no provider could use.
    """

    def __init__(self, message: str, *, hint: str = "", code: str = "", reason: str = "") -> None:
        super().__init__(message, hint=hint, code=code)
        self.reason = reason


def unusable(reason: str, why: str, *, hint: str = "") -> WebError:
    """The error for an order that no provider could use."""
    return WebError(f"{why} ({reason})", hint=hint, code="order-unusable", reason=reason)


STATUSES: Final = {
    "content-unavailable": 404,
    "held-on-machine": 409,
    "invalid-address": 400,
    "invalid-amount": 400,
    "login-required": 401,
    "no-local-account": 409,
    "not-a-liability": 404,
    "operators-only": 403,
    "page-not-found": 404,
    "too-many-requests": 429,
    "unknown-name": 404,
    "upload-too-large": 413,
    "uploads-busy": 503,
    "why-too-long": 400,
    "wrong-host": 421,
    "wrong-origin": 403,
}
"""The HTTP status of an error by its code, where its class does not say enough."""


def status_of(error: AiraError) -> int:
    is_theirs = isinstance(error, WebError | InputError) or error.code == "validator-doubtful"
    return STATUSES.get(error.code, 400 if is_theirs else 502)


T = TypeVar("T")

SENDER: Final = web.RequestKey("sender", str)
"""Who sent a request, as limits tell people apart."""
SANDBOX: Final = {"Content-Security-Policy": "default-src 'none'; sandbox"}
"""What strangers made is shown by nothing but our own page."""
FOREVER: Final = {"Cache-Control": "private, max-age=31536000, immutable"}
"""What a CID names never changes."""


def answer(content: Any, *, status: int = 200) -> web.Response:
    return web.Response(body=msgspec.json.encode(content), status=status, content_type="application/json")


async def body_of(request: web.Request, kind: type[T]) -> T:
    """The JSON body. Raises `WebError`."""
    try:
        return decode_json(await request.read(), kind)
    except InvalidData as error:
        raise WebError(f"the body: {error}"[:200]) from None


def address_in(request: web.Request) -> str:
    return parse_address(request.match_info["address"])


def cid_in(request: web.Request) -> str:
    return parse_text_cid(request.match_info["cid"])


def parse_text_cid(text: str) -> str:
    """The text, if it is a CID. Raises `InvalidCid`."""
    parse_cid(text)
    return text


def amount(text: str) -> int:
    """An amount in the smallest unit. Raises `WebError`."""
    if not (text.isascii() and text.isdigit() and len(text) <= 78):
        raise WebError("an amount is a decimal number in the smallest unit")
    return int(text)


def number_in(request: web.Request, name: str, default: int, *, least: int = 0, most: int = 10**9) -> int:
    """A number in the query, at most `most`. Raises `WebError`."""
    text = request.query.get(name, "")
    if not text:
        return default
    try:
        number = int(text)
    except ValueError:
        raise WebError(f"{name} is a number") from None
    if number < least:
        raise WebError(f"{name} is at least {least}")
    return min(number, most)


STATIC: Final = Path(__file__).with_name("static")
"""The folder of the built page."""


@dataclass(frozen=True, kw_only=True)
class WebOptions(ServerOptions):
    """How the page is served."""

    protection: ClassVar[str] = "--certificate, --key and --token-file or --roster"
    names: tuple[str, ...] = ()
    """Names besides its own address by which browsers reach it: `HOST` at any port, or `HOST:PORT`."""
    operator_token: str = field(default="", repr=False)
    roster: str = ""
    """The site's roster: members who show a certificate of `ca` need no token, and its operators are operators."""
    ca: str = ""
    proxies: tuple[str, ...] = ()
    """Addresses of proxies in front, whose header `X-Forwarded-For` says who asks."""
    embed: tuple[str, ...] = ()
    """Origins that may show the page in a frame."""
    robot: dict[str, Any] | None = None
    """The one robot that the page orders from: see Robot in openapi.json."""
    signer: str = ""
    """The `owner.sock` of a signer: operators who logged in allow or deny what programs order there."""
    explorer: str = ""
    from_block: int = 0
    static: Path = STATIC

    def check(self) -> None:
        """Raise `ConfigurationError` for a server that other machines can reach without TLS and login."""
        if self.roster and not (self.certificate and self.key and self.ca):
            raise ConfigurationError(
                "members of a roster log in by TLS",
                hint="with --roster give --certificate, --key and --tls-ca",
                code="web-not-protected",
            )
        if self.signer and not (self.operator_token or self.roster):
            # On this machine everybody is an operator without a login: the programs that ask, too.
            raise ConfigurationError(
                "people who allow orders of programs must log in as operators",
                hint="with --signer give --operator-token-file",
                code="web-not-protected",
            )
        super().check()

    @property
    def has_login(self) -> bool:
        """Whether people, or operators only, can log in."""
        return bool(self.token or self.operator_token or self.roster)


log = logging.getLogger(__name__)

COOKIE: Final = "aira_session"
SESSION_SECONDS: Final = 12 * 3600.0


class Login(NamedTuple):
    """Whose request it is: what it may do (`operator` or `anybody`), and who sent it, as limits tell people apart."""

    role: str
    sender: str


class LoginRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A token to log in with."""

    token: str


class Logins:
    """The sessions of one server, and the members of its roster, which may change at any time.

    Without a login, and `has_account`, all are operators: they can spend that account's money already. Raises
    `ConfigurationError` for a roster that can't be read at the start.
    """

    def __init__(self, options: WebOptions, *, has_account: bool = False) -> None:
        self._options = options
        self._all_are_operators = has_account and not options.has_login
        self._sessions: BoundedDict[str, tuple[str, float]] = BoundedDict(1024)
        self._roster: FreshFile[Roster] | None = None
        if options.roster:
            self._roster = FreshFile(Path(options.roster).expanduser(), read_roster, on_error=_log_error)

    @property
    def is_needed(self) -> bool:
        """Whether the interface is for those only who logged in; else operators only log in."""
        return bool(self._options.token or self._options.roster) or not is_loopback(self._options.host)

    def role_of(self, request: web.Request) -> str:
        """`operator` or `anybody`: what the session of a request may do."""
        login = self.login_of(request)
        if self._all_are_operators:
            return "operator"
        return "anybody" if login is None else login.role

    def require_operator(self, request: web.Request, what: str) -> None:
        """Raise `WebError` for who may not do `what`."""
        if self.role_of(request) != "operator":
            raise WebError(f"only operators {what}", hint="log in as an operator", code="operators-only")

    def require_operator_login(self, request: web.Request, what: str) -> None:
        """The same, also where all are operators without a login."""
        login = self.login_of(request)
        if login is None or login.role != "operator":
            raise WebError(f"only operators who logged in {what}", hint="log in as an operator", code="operators-only")

    def login_of(self, request: web.Request) -> Login | None:
        """Whose request it is; None without a login."""
        session = request.cookies.get(COOKIE, "")
        role, until = self._sessions.get(session, ("", 0.0))
        own = Login(role, session) if time.monotonic() < until else None
        member = self._member(request)
        if member is None or (own is not None and own.role == "operator"):
            return own
        return Login("operator" if "operator" in member.roles else "anybody", member.address)

    async def log_in(self, request: web.Request) -> web.Response:
        """Answer a token with a session. Raises `WebError`.

        The right token is taken however many wrong ones came from the same address: perhaps another's, and a token
        can't be guessed.
        """
        given = (await body_of(request, LoginRequest)).token.encode(errors="replace")
        roles = (("operator", self._options.operator_token), ("anybody", self._options.token))
        role = next((name for name, token in roles if token and hmac.compare_digest(token.encode(), given)), None)
        if role is None:
            raise WebError("this is not the token", code="login-required")
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
        context = options.tls()
        if context is not None and options.roster:
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
