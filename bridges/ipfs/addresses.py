"""Addresses of a daemon's RPC or a gateway: multiaddrs and URLs. Pure."""

from __future__ import annotations

from typing import Final
from urllib.parse import urlsplit

from mesh.errors import ConfigurationError

_HINT: Final = "write it as /ip4/127.0.0.1/tcp/5001 or http://127.0.0.1:5001"
_HOSTS: Final = ("ip4", "ip6", "dns", "dns4", "dns6", "dnsaddr")
_HIGHEST_PORT: Final = 65_535


def base_url(text: str) -> str:
    """The URL for `text`, which is a URL or a multiaddr, without a trailing slash.

    Multiaddrs look like `/ip4/127.0.0.1/tcp/5001`, optionally followed by `/http`, `/https` or `/tls/http`. Raises
    `ConfigurationError`.
    """
    url = _of_multiaddr(text) if text.startswith("/") else text
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # an invalid port, or an unclosed bracket
        usable = False
    if not usable or parts.query or parts.fragment:
        raise ConfigurationError(f"{text!r} is not the address of an IPFS daemon or gateway", hint=_HINT)
    return url.rstrip("/")


def without_credentials(url: str) -> str:
    """The URL without user name and password, for display."""
    scheme, _, rest = url.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}"


def _of_multiaddr(text: str) -> str:
    match text.rstrip("/").split("/")[1:]:
        case [kind, host, "tcp", port, *rest] if kind in _HOSTS and host and _is_port(port):
            scheme = {(): "http", ("http",): "http", ("https",): "https", ("tls", "http"): "https"}.get(tuple(rest))
            if scheme is not None:
                return f"{scheme}://{f'[{host}]' if kind == 'ip6' else host}:{port}"
    raise ConfigurationError(f"{text!r} is not a multiaddr of an IPFS daemon's RPC", hint=_HINT)


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and 0 < int(text) <= _HIGHEST_PORT
