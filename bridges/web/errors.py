"""The errors that the page's server answers with; each has its HTTP status."""

from __future__ import annotations

from typing import ClassVar

from mesh.cli.errors import DoubtfulValidator
from mesh.errors import AiraError, ConfigurationError, InputError


class WebError(AiraError, code="web-error"):
    """A request can't be served."""

    status: ClassVar[int] = 400


class InvalidRequest(WebError, code="invalid-request"):
    """A request's body, path or query is not what the interface says."""


class WrongHost(WebError, code="wrong-host"):
    """The request names another host: a page of another site may have been led here by its DNS."""

    status = 421


class WrongOrigin(WebError, code="wrong-origin"):
    """The request comes from a page of another site, or lacks the header that only our page sends."""

    status = 403


class LoginRequired(WebError, code="login-required"):
    """The server has a token file, and the request has no valid session."""

    status = 401


class OperatorsOnly(WebError, code="operators-only"):
    """Only operators may do this."""

    status = 403


class TooManyRequests(WebError, code="too-many-requests"):
    """The client sends more requests than the server allows."""

    status = 429


class PageNotFound(WebError, code="page-not-found"):
    """There is nothing under this address."""

    status = 404


class UploadTooLarge(WebError, code="upload-too-large"):
    """A body has more bytes than the server takes."""

    status = 413


class OrderUnusable(InputError, code="order-unusable"):
    """No provider could use an order. `reason` is a word for programs, as in rejections."""

    def __init__(self, reason: str, why: str, *, hint: str = "") -> None:
        super().__init__(f"{why} ({reason})", hint=hint)
        self.reason = reason


class NoLocalAccount(WebError, code="no-local-account"):
    """The server was started without an account."""

    status = 409


class NotOpenToOthers(ConfigurationError, code="web-not-protected"):
    """The server is to listen for other machines, without TLS or without a login."""


def status_of(error: AiraError) -> int:
    """The HTTP status for an error."""
    if isinstance(error, WebError):
        return error.status
    if error.code in ("not-a-liability", "content-unavailable", "unknown-name"):
        return 404
    return 400 if isinstance(error, InputError | DoubtfulValidator) else 502
