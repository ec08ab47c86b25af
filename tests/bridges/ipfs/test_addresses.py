from __future__ import annotations

import pytest

from bridges.ipfs.daemon import base_url, without_credentials
from mesh.errors import ConfigurationError


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("/ip4/127.0.0.1/tcp/5001", "http://127.0.0.1:5001"),
        ("/ip4/127.0.0.1/tcp/5001/http", "http://127.0.0.1:5001"),
        ("/ip6/::1/tcp/5001", "http://[::1]:5001"),
        ("/dns/ipfs.example.org/tcp/443/https", "https://ipfs.example.org:443"),
        ("/dns4/ipfs.example.org/tcp/443/tls/http", "https://ipfs.example.org:443"),
        ("http://127.0.0.1:5001", "http://127.0.0.1:5001"),
        ("https://ipfs.example.org/", "https://ipfs.example.org"),
        ("https://example.org/behind/a/proxy", "https://example.org/behind/a/proxy"),
    ],
)
def test_an_address_is_a_multiaddr_or_a_url(text: str, url: str) -> None:
    assert base_url(text) == url


@pytest.mark.parametrize(
    "text",
    [
        "",
        "127.0.0.1:5001",
        "ftp://127.0.0.1:5001",
        "http://",
        "http://127.0.0.1:ninety",
        "http://127.0.0.1:99999",
        "http://[::1",
        "http://127.0.0.1:5001/?a=b",
        "/ip4/127.0.0.1",
        "/ip4/127.0.0.1/udp/5001",
        "/ip4/127.0.0.1/tcp/0",
        "/ip4/127.0.0.1/tcp/65536",
        "/ip4/127.0.0.1/tcp/5001/ws",
        "/unix/run/ipfs.sock",
    ],
)
def test_invalid_addresses_are_rejected_with_an_example(text: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        base_url(text)
    assert "/ip4/127.0.0.1/tcp/5001" in refused.value.hint


def test_a_password_in_a_url_is_not_shown() -> None:
    assert without_credentials("https://me:secret@example.org/x") == "https://example.org/x"
    assert without_credentials("https://example.org/x") == "https://example.org/x"
