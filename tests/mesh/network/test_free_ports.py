"""Locators with port 0, which would tell others to connect to port 0."""

from __future__ import annotations

import re

import pytest

from mesh.network.locators import with_free_ports


@pytest.mark.parametrize("before", ["tcp/127.0.0.1:", "udp/127.0.0.1:", "tcp/localhost:", "tls/127.0.0.1:"])
def test_port_0_becomes_a_free_one(before: str) -> None:
    first, second = with_free_ports((f"{before}0", f"{before}0?rel=1"))
    assert re.fullmatch(re.escape(before) + r"[1-9]\d+", first)
    assert re.fullmatch(re.escape(before) + r"[1-9]\d+\?rel=1", second)


@pytest.mark.parametrize("locator", ["tcp/127.0.0.1:7447", "tcp/[::1]:70", "unixsock-stream//tmp/x:0", "tcp/h:10"])
def test_other_locators_stay(locator: str) -> None:
    assert with_free_ports((locator,)) == (locator,)
