"""The state file of anvil after crashes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.chain import Account, Node, TransactionSender
from mesh.dev import development
from mesh.dev.anvil import prepare_state, serve_anvil, state_copy
from mesh.dev.development import serve_chain
from mesh.errors import AiraError, ConfigurationError
from mesh.settings import Settings
from tests.support.log_events import logged_events
from tests.support.peers import require
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from mesh.dev.development import DevelopmentChain

NEW_ACCOUNT = "0x00000000000000000000000000000000000000AA"


async def test_a_damaged_state_is_replaced_by_the_last_whole_copy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    program, state = require("anvil"), tmp_path / "state.json"
    async with (
        serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=state) as node,
        Node(node.url) as client,
    ):
        await TransactionSender(client, Account(node.funded_keys[0])).send(to=NEW_ACCOUNT, data=b"", value=7)
        await until(
            lambda: state_copy(state).exists() and NEW_ACCOUNT[2:].lower() in state_copy(state).read_text().lower(),
            what="a copy with the payment in it",
            seconds=30,
        )
    whole = state.read_bytes()
    state.write_bytes(whole[: len(whole) // 2])
    async with (
        serve_anvil(program, host="127.0.0.1", port=0, block_time=None, state=state) as node,
        Node(node.url) as client,
    ):
        assert await client.eth_balance(NEW_ACCOUNT) == 7
    assert "chain-state-restored" in logged_events(caplog)


async def test_a_chain_is_kept_only_with_all_its_contracts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = tmp_path / "state.json"

    def served() -> AbstractAsyncContextManager[DevelopmentChain]:
        settings, anvil = Settings(data_dir=str(tmp_path)), require("anvil")
        return serve_chain(settings, host="127.0.0.1", port=0, block_time=None, anvil=anvil, state=state)

    with monkeypatch.context() as patched:
        patched.setattr(development, "STAKE", development.ALLOWANCE * 10**9)  # the last step of the deployment fails
        with pytest.raises(AiraError):
            await served().__aenter__()
    assert not state.exists()
    lighthouses = []
    for _ in range(4):  # stopped at once each time
        async with served() as chain:
            lighthouses.append(chain.market.deployment.lighthouse)
    assert lighthouses == [lighthouses[0]] * 4


def test_without_a_copy_a_damaged_state_is_an_error_and_is_not_changed(tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    for file in (state, state_copy(state)):
        file.write_bytes(b'{"accounts": {')
    with raises_with(ConfigurationError, code="invalid-chain-state", match=str(state)):
        prepare_state(state)
    assert state.read_bytes() == state_copy(state).read_bytes() == b'{"accounts": {'


def test_a_whole_chain_is_not_replaced_by_an_older_one(tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    state.write_bytes(b'{"accounts": {}, "block": 2}')
    state_copy(state).write_bytes(b'{"accounts": {}, "block": 1}')
    prepare_state(state)
    assert state.read_bytes() == b'{"accounts": {}, "block": 2}'
