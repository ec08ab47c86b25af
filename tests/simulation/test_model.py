"""The model of the contracts does what the contracts do on the EVM: answers, reasons, events, all that can be read."""

from __future__ import annotations

import os
import random
from typing import Any, Final

import pytest
from eth_abi.abi import encode
from eth_bloom.bloom import BloomFilter
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from mesh.chain import XRT, Account
from mesh.chain._accounts import created_address
from schemas import address_bytes, keccak256
from tests.simulation.model import ModelChain, bloom_of
from tests.simulation.model_abi import artifact
from tests.simulation.model_history import ModelHistory, twins
from tests.simulation.model_twins import call_of
from tests.support.ci import IN_CI, seed_of_part

HISTORIES: Final = int(os.environ.get("AIRA_MODEL_HISTORIES", "12" if IN_CI else "8"))
AT_A_TIME: Final = 6
"""Histories in one test: few enough to stay far below the time limit of a test on a busy machine."""
STEPS: Final = 60
SHOWN: Final = ("status", "contractAddress", "from", "to", "blockNumber", "transactionIndex", "type")


@pytest.mark.parametrize("first", range(0, HISTORIES, AT_A_TIME))
def test_the_model_does_what_the_contracts_do(first: int) -> None:
    @seed(seed_of_part(first))
    @settings(max_examples=min(AT_A_TIME, HISTORIES - first), deadline=None, suppress_health_check=list(HealthCheck))
    @given(number=st.integers(0, 2**64), steps=st.integers(1, STEPS))
    def play(number: int, steps: int) -> None:
        ModelHistory(number, steps).play()

    play()


class Usual(random.Random):
    """Chooses what comes first, which is what works."""

    def choice(self, seq: Any) -> Any:
        return seq[0]


@pytest.mark.parametrize("way", range(4))
def test_the_model_owes_what_a_token_refuses_to_pay_and_pays_it_when_it_is_claimed(way: int) -> None:
    history = ModelHistory(0, 0)
    history.chance = Usual()
    token, factory, people = history.known["blocking"], history.known["factory"], history.twins.people
    history.do(people[3], history.known["lighthouse"], call_of("Lighthouse", "refill", 3 * XRT))
    history.do(people[0], token, call_of("BlockingToken", "setRefusal", way))
    history.do(people[0], token, call_of("BlockingToken", "setBlocked", people[2], True))
    for _ in range(2):
        history.create(token=token, cost=XRT, promisee=1, promisor=2)
        history.made.reverse()
        history.finish()
    assert history.debts == [(token, people[2])] * 2

    claim = call_of("Factory", "claim", token, people[2])
    elsewhere = call_of("Factory", "claimTo", token, people[4])
    calls = (people[2], claim), (people[4], elsewhere), (people[2], elsewhere), (people[2], elsewhere)
    assert [history.do(sender, factory, data).succeeded for sender, data in calls] == [False, False, True, False]
    history.compare_everything()


def test_the_chain_of_the_model_shows_what_the_chain_of_the_evm_shows() -> None:
    """The deployment: receipts, transactions and logs, but for gas, prices and hashes of blocks."""
    both = twins()
    for number in range(1, both.evm.head + 1):
        expected, found = (_block(chain, number) for chain in (both.evm, both.model))
        assert found == expected


def _block(chain: Any, number: int) -> dict[str, Any]:
    (hash_,) = chain.block(number, transactions="hashes")["transactions"]
    receipt, transaction = chain.receipt(bytes.fromhex(hash_[2:])), chain.transaction(bytes.fromhex(hash_[2:]))
    shown = {name: receipt[name] for name in SHOWN}
    shown["logs"] = [(log["address"], log["topics"], log["data"], log["logIndex"]) for log in receipt["logs"]]
    return shown | {name: transaction[name] for name in ("to", "nonce", "input", "value")}


def test_a_modelled_block_has_the_bloom_filter_of_its_logs() -> None:
    address, topics = b"\x11" * 20, [keccak256(b"NewLiability(address)"), bytes(32)]
    assert bloom_of([(address, topics, b"")]) == int(BloomFilter.from_iterable([address, *topics]))
    assert bloom_of([]) == 0


def test_the_transactions_of_a_block_see_what_those_before_them_did() -> None:
    chain = ModelChain(twins().evm.funded_keys)
    maker, friend = (Account(key) for key in chain.funded_keys[:2])
    token = created_address(maker.address, 0)
    fees = {"chainId": chain.chain_id, "maxPriorityFeePerGas": 1, "maxFeePerGas": 2 * chain.base_fee, "value": 0}

    def signed(account: Account, nonce: int, to: str, data: bytes) -> bytes:
        fields = fees | {"nonce": nonce, "to": to or b"", "data": "0x" + data.hex(), "gas": 5_000_000 // (nonce + 1)}
        return account.sign_transaction(fields).raw

    deploy = bytes.fromhex(artifact("XRT")["bytecode"][2:]) + encode(["uint256"], [9])
    give, return_ = (call_of("XRT", "transfer", address_bytes(to.address), 2) for to in (friend, maker))
    raws = [signed(maker, 0, "", deploy), signed(maker, 1, token, give), signed(maker, 5, token, give)]
    raws.append(signed(friend, 0, token, return_))
    mined = [chain.read(raw).hash for raw in raws if raw is not raws[2]]
    assert chain.mine_together(raws) == set(mined)

    receipts: list[Any] = [chain.receipt(hash_) for hash_ in mined]
    assert [(one["status"], one["transactionIndex"], one["blockNumber"]) for one in receipts] == [
        ("0x1", "0x0", "0x1"),
        ("0x1", "0x1", "0x1"),
        ("0x1", "0x2", "0x1"),
    ]
    assert [log["logIndex"] for log in chain.logs(1, 1)] == ["0x0", "0x1", "0x2"]
    assert chain.nonce(address_bytes(maker.address), 1) == 2
    chain.rewind(0)
    assert [chain.receipt(hash_) for hash_ in mined] == [None] * 3
    assert chain.nonce(address_bytes(maker.address), 0) == 0
