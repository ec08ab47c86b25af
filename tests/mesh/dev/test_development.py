"""The served development chain: its keyfiles, and its errors."""

from __future__ import annotations

import errno
import os
import stat
from typing import TYPE_CHECKING

import pytest

from mesh.chain import Account, Chain
from mesh.dev.development import ALLOWANCE, ROLES, DevelopmentChain, serve_chain
from mesh.errors import ConfigurationError
from mesh.settings import Settings
from tests.support.ports import answers
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path


async def test_the_keyfiles_are_of_funded_accounts_and_remain(tmp_path: Path) -> None:
    settings = Settings(data_dir=str(tmp_path))
    async with serve_chain(settings, host="127.0.0.1", port=0, block_time=None) as served:
        accounts = [Account.from_keyfile(served.keys / f"{role}.json", served.keys / "password") for role in ROLES]
        assert [account.address for account in accounts] == [served.market.accounts[role].address for role in ROLES]
        assert {stat.S_IMODE(path.stat().st_mode) for path in served.keys.iterdir()} == {0o600}
        async with Chain(served.url, contracts=served.market.deployment.contracts) as chain:
            assert [await chain.tokens.balance(account.address) for account in accounts[1:]] == [ALLOWANCE] * 2
        assert_described(served)
        before = {path.name: path.read_bytes() for path in served.keys.iterdir()}
        port = int(served.url.rpartition(":")[2])
    assert not answers(port)
    async with serve_chain(settings, host="127.0.0.1", port=0, block_time=None) as again:
        assert {path.name: path.read_bytes() for path in again.keys.iterdir()} == before


def assert_described(served: DevelopmentChain) -> None:
    lines = served.describe().splitlines()
    port = served.url.rpartition(":")[2]
    assert lines[:2] == [f"chain       {served.url}", f"websocket   ws://127.0.0.1:{port}"]
    for role in ("robot", "person"):
        assert f"{role:<11} {served.keys / role}.json  {served.market.accounts[role].address}" in lines
    assert lines[-1] == f"password    {served.keys / 'password'}"


async def test_a_data_folder_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    refused = f"{file / 'development'}: {os.strerror(errno.ENOTDIR)}"
    with raises_with(ConfigurationError, code="keyfiles-not-writable", match=refused):
        async with serve_chain(Settings(data_dir=str(file)), host="127.0.0.1", port=0, block_time=None):
            pytest.fail("it serves")
