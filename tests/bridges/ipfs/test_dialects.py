from __future__ import annotations

import pytest

from bridges.ipfs.dialects import Event, Multibase, Plain, Version, dialect_of


@pytest.mark.parametrize(
    ("version", "name"),
    [
        (Version(version="0.4.18", golang="go1.11.1"), "plain"),
        (Version(version="0.10.0", golang="go1.16"), "plain"),
        (Version(version="0.11.0-rc1", golang="go1.16"), "multibase"),
        (Version(version="0.22.0", golang="go1.20"), "multibase"),
        (Version(version="0.44.0-dev", golang="go1.26"), "multibase"),
        (Version(version="1.0.0", golang="go1.27"), "multibase"),
        (Version(version="0.18.1", js_core="0.18.1", js_interface="^0.158.1"), "multibase"),
        (Version(version="0.12.2", js_core="0.12.2", js_interface="^0.152.2"), "plain"),
        (Version(version="0.43.3", js_interface="^0.133.1"), "plain"),
        (Version(version="unknown"), "multibase"),
        (Version(), "multibase"),
    ],
)
def test_a_daemons_version_tells_its_dialect(version: Version, name: str) -> None:
    assert dialect_of(version).name == name


def test_a_daemon_is_called_what_it_was_called_then() -> None:
    assert str(Version(version="0.13.1")) == "go-ipfs 0.13.1"
    assert str(Version(version="0.44.0-dev")) == "kubo 0.44.0-dev"
    assert str(Version(version="0.18.1", js_core="0.18.1")) == "js-ipfs 0.18.1"


@pytest.mark.parametrize("version", [Version(version="0.18.1", js_core="0.18.1"), Version(js_interface="^0.133.1")])
def test_js_ipfs_is_told_from_the_others(version: Version) -> None:
    assert version.is_js
    assert not Version(version="0.44.0", golang="go1.26").is_js


def test_multibase_writes_topics_as_base64url_without_padding() -> None:
    assert Multibase().topic("a.lighthouse") == "uYS5saWdodGhvdXNl"
    assert Multibase().topic("topic?>") == "udG9waWM_Pg"
    assert Multibase().publication(b"\x00\n") == ([], b"\x00\n")


def test_plain_writes_topics_and_data_as_they_are() -> None:
    assert Plain().topic("a.lighthouse") == "a.lighthouse"
    assert Plain().publication(b'{"tx":"\xc3\xa4"}') == ([("arg", '{"tx":"ä"}')], None)


def test_each_reads_its_own_lines() -> None:
    assert Multibase().event(b'{"from":"12D3","data":"uAP8gYmlu","seqno":"uAQ","topicIDs":["udA"]}') == Event(
        "12D3", b"\x00\xff bin"
    )
    assert Plain().event(b'{"from":"EiA=","data":"AP8gYmlu","seqno":"AQ==","topicIDs":["t"]}') == Event(
        "EiA=", b"\x00\xff bin"
    )


@pytest.mark.parametrize("dialect", [Multibase(), Plain()])
def test_a_line_without_data_is_no_message_and_no_error(dialect: Multibase | Plain) -> None:
    assert dialect.event(b"{}") is None


@pytest.mark.parametrize("dialect", [Multibase(), Plain()])
@pytest.mark.parametrize(
    "line", [b"", b"[]", b"{", b'{"data":7}', b'{"data":"*"}', b'{"data":"u*"}', b'{"data":"\xff"}', b'{"data":"uA"}x']
)
def test_rubbish_is_an_error_of_its_line(dialect: Multibase | Plain, line: bytes) -> None:
    with pytest.raises(ValueError, match="not"):
        dialect.event(line)
