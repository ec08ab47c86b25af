"""The dialects of the PubSub RPC, and lines of a subscription."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bridges.ipfs.daemon import DaemonVersion, MultibaseDialect, PubsubDialect, PubsubMessage, dialect_of, lines_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@pytest.mark.parametrize(
    ("version", "name"),
    [
        (DaemonVersion(version="0.4.18", golang="go1.11.1"), "plain"),
        (DaemonVersion(version="0.10.0", golang="go1.16"), "plain"),
        (DaemonVersion(version="0.11.0-rc1", golang="go1.16"), "multibase"),
        (DaemonVersion(version="0.22.0", golang="go1.20"), "multibase"),
        (DaemonVersion(version="0.44.0-dev", golang="go1.26"), "multibase"),
        (DaemonVersion(version="1.0.0", golang="go1.27"), "multibase"),
        (DaemonVersion(version="0.18.1", js_core="0.18.1", js_interface="^0.158.1"), "multibase"),
        (DaemonVersion(version="0.12.2", js_core="0.12.2", js_interface="^0.152.2"), "plain"),
        (DaemonVersion(version="0.43.3", js_interface="^0.133.1"), "plain"),
        (DaemonVersion(version="unknown"), "multibase"),
        (DaemonVersion(), "multibase"),
    ],
)
def test_the_dialect_follows_from_the_version(version: DaemonVersion, name: str) -> None:
    assert dialect_of(version).name == name


def test_a_version_names_the_daemon() -> None:
    assert str(DaemonVersion(version="0.13.1")) == "go-ipfs 0.13.1"
    assert str(DaemonVersion(version="0.44.0-dev")) == "kubo 0.44.0-dev"
    assert str(DaemonVersion(version="0.18.1", js_core="0.18.1")) == "js-ipfs 0.18.1"


@pytest.mark.parametrize(
    "version", [DaemonVersion(version="0.18.1", js_core="0.18.1"), DaemonVersion(js_interface="^0.133.1")]
)
def test_js_ipfs_is_recognized(version: DaemonVersion) -> None:
    assert version.is_js
    assert not DaemonVersion(version="0.44.0", golang="go1.26").is_js


def test_multibase_writes_topics_as_base64url_without_padding() -> None:
    assert MultibaseDialect().topic("a.lighthouse") == "uYS5saWdodGhvdXNl"
    assert MultibaseDialect().topic("topic?>") == "udG9waWM_Pg"
    assert MultibaseDialect().publication(b"\x00\n") == ([], b"\x00\n")


def test_plain_writes_topics_and_data_as_they_are() -> None:
    assert PubsubDialect().topic("a.lighthouse") == "a.lighthouse"
    assert PubsubDialect().publication(b'{"tx":"\xc3\xa4"}') == ([("arg", '{"tx":"ä"}')], None)


def test_each_dialect_reads_its_own_lines() -> None:
    assert MultibaseDialect().message(
        b'{"from":"12D3","data":"uAP8gYmlu","seqno":"uAQ","topicIDs":["udA"]}'
    ) == PubsubMessage("12D3", b"\x00\xff bin")
    assert PubsubDialect().message(
        b'{"from":"EiA=","data":"AP8gYmlu","seqno":"AQ==","topicIDs":["t"]}'
    ) == PubsubMessage("EiA=", b"\x00\xff bin")


@pytest.mark.parametrize("dialect", [MultibaseDialect(), PubsubDialect()])
def test_a_line_without_data_is_neither_message_nor_error(dialect: PubsubDialect) -> None:
    assert dialect.message(b"{}") is None


@pytest.mark.parametrize("dialect", [MultibaseDialect(), PubsubDialect()])
@pytest.mark.parametrize(
    "line", [b"", b"[]", b"{", b'{"data":7}', b'{"data":"*"}', b'{"data":"u*"}', b'{"data":"\xff"}', b'{"data":"uA"}x']
)
def test_an_unreadable_line_is_an_error(dialect: PubsubDialect, line: bytes) -> None:
    with pytest.raises(ValueError, match="not"):
        dialect.message(line)


TEXT = b"one\n\ntwo two\nthree"


async def pieces(data: bytes, size: int) -> AsyncIterator[bytes]:
    for start in range(0, len(data), size):
        yield data[start : start + size]


@pytest.mark.parametrize("size", range(1, len(TEXT) + 1))
async def test_lines_do_not_depend_on_the_chunks(size: int) -> None:
    assert [line async for line in lines_of(pieces(TEXT, size), limit=100)] == [b"one", b"", b"two two"]


@pytest.mark.parametrize("size", range(1, len(TEXT) + 1))
async def test_a_line_beyond_the_limit_is_empty_and_the_next_one_complete(size: int) -> None:
    assert [line async for line in lines_of(pieces(b"123456\n12345\n1234567\nend\n", size), limit=5)] == [
        b"",
        b"12345",
        b"",
        b"end",
    ]
