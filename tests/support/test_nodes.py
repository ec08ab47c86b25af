from __future__ import annotations

import json
import urllib.request
from typing import TYPE_CHECKING, Any

from schemas import Signer

if TYPE_CHECKING:
    from tests.support.nodes import Anvil


def call(url: str, method: str, *parameters: object) -> Any:
    body = {"jsonrpc": "2.0", "id": 1, "method": method, "params": parameters}
    request = urllib.request.Request(url, data=json.dumps(body).encode(), headers={"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=10) as response:
        return json.load(response)["result"]


def test_anvil_answers_with_the_number_of_its_first_block(anvil: Anvil) -> None:
    assert call(anvil.url, "eth_blockNumber") == "0x0"
    assert call(anvil.url, "eth_chainId") == hex(31337)


def test_anvil_gives_ten_funded_keys(anvil: Anvil) -> None:
    assert len({Signer(key).address for key in anvil.private_keys}) == 10
    accounts = call(anvil.url, "eth_accounts")
    assert [call(anvil.url, "eth_getBalance", account, "latest") for account in accounts] == [hex(10**22)] * 10


def test_anvil_starts_again_with_a_new_chain(anvil: Anvil) -> None:
    call(anvil.url, "anvil_mine", 5)
    assert call(anvil.url, "eth_blockNumber") == "0x5"
    anvil.stop()
    anvil.start()
    assert call(anvil.url, "eth_blockNumber") == "0x0"
