"""The contracts, deployed on a test chain, and the accounts that use them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from web3.logs import DISCARD

from schemas import Signer, keccak256

if TYPE_CHECKING:
    from web3.contract import Contract
    from web3.types import TxReceipt

    from tests.support.contracts.chains import Chain

ROOT: Final = Path(__file__).parents[3]
SUITE: Final = ROOT / "mesh" / "chain" / "artifacts"
FOR_TESTS: Final = ROOT / "tests" / "contracts" / "artifacts"

XRT: Final = 10**9
"""One XRT in wn."""

SUPPLY: Final = 10**6 * XRT
REFUND_DELAY: Final = 20
"""Blocks."""


@cache
def artifact(name: str) -> dict[str, Any]:
    """A built contract, of the suite or of those that only tests use."""
    path = SUITE / f"{name}.json"
    content: dict[str, Any] = json.loads((path if path.exists() else FOR_TESTS / f"{name}.json").read_text())
    return content


def namehash(name: str) -> bytes:
    """The node of an ENS name (EIP-137)."""
    node = bytes(32)
    for label in reversed(name.split(".")):
        node = keccak256(node + keccak256(label.encode()))
    return node


@dataclass(frozen=True)
class Person:
    """A person with an account on the chain; its key signs messages."""

    address: str
    signer: Signer


class Suite:
    """The deployed contracts. The first person deploys and holds the XRT that the others are given."""

    def __init__(
        self, chain: Chain, *, refund_delay: int = REFUND_DELAY, supply: int = SUPPLY, emission: int = 100
    ) -> None:
        self.chain = chain
        self.web3 = chain.web3
        self.people = tuple(Person(Signer(key).address, Signer(key)) for key in chain.keys)
        self.deployer = self.people[0]
        self.ens = self.deploy("ENSRegistry")
        self.resolver = self.deploy("Resolver", self.ens.address)
        self.xrt = self.deploy("XRT", supply)
        self.factory = self.deploy("Factory", self.ens.address, self.xrt.address, refund_delay, emission)
        self.send(self.xrt.functions.setMinter(self.factory.address))
        self._name()

    def deploy(self, name: str, *arguments: Any) -> Contract:
        """A new contract of the deployer's."""
        built = artifact(name)
        constructor = self.web3.eth.contract(abi=built["abi"], bytecode=built["bytecode"]).constructor(*arguments)
        address = self.send(constructor)["contractAddress"]
        assert address is not None
        return self.contract(name, address)

    def contract(self, name: str, address: str) -> Contract:
        """A contract that is there."""
        return self.web3.eth.contract(address, abi=artifact(name)["abi"])  # type: ignore[call-overload, no-any-return]

    def send(self, call: Any, sender: Person | None = None) -> TxReceipt:
        """Send a transaction that must succeed, from the deployer by default."""
        receipt = self.attempt(call, sender)
        assert receipt["status"] == 1, f"reverted: {self.chain.refusal(call, (sender or self.deployer).address)}"
        return receipt

    def attempt(self, call: Any, sender: Person | None = None) -> TxReceipt:
        """Send a transaction, which may revert."""
        fields = {"from": (sender or self.deployer).address, "gas": 8_000_000}
        return self.web3.eth.wait_for_transaction_receipt(call.transact(fields), poll_latency=0.005)

    def fund(self, person: Person, value: int, spender: str) -> None:
        """Give a person XRT (wn) that `spender` may take."""
        self.send(self.xrt.functions.transfer(person.address, value))
        self.send(self.xrt.functions.approve(spender, value), person)

    def create_lighthouse(self, *, stake: int = XRT, timeout: int = 10, name: str = "airalab") -> Contract:
        """A lighthouse without providers; `stake` in wn, `timeout` in blocks."""
        receipt = self.send(self.factory.functions.createLighthouse(stake, timeout, name))
        (event,) = self.factory.events.NewLighthouse().process_receipt(receipt, errors=DISCARD)
        return self.contract("Lighthouse", event["args"]["lighthouse"])

    def implementation(self, clone: Contract) -> str:
        """The contract whose code a lighthouse or liability runs (EIP-1167)."""
        return self.chain.web3.to_checksum_address(self.chain.web3.eth.get_code(clone.address)[10:30])

    def join(self, lighthouse: Contract, provider: Person, stake: int) -> None:
        """Make a person a provider with that stake in wn."""
        self.fund(provider, stake, lighthouse.address)
        self.send(lighthouse.functions.refill(stake), provider)

    def balance(self, account: Person | Contract) -> int:
        """wn that an account holds."""
        return int(self.xrt.functions.balanceOf(account.address).call())

    def address_of(self, name: str) -> str:
        """What the resolver answers for a name."""
        return str(self.resolver.functions.addr(namehash(name)).call())

    def _name(self) -> None:
        owner = self.deployer.address
        self._own("", "eth", owner)
        self._own("eth", "robonomics", owner)
        for generation in "35":
            root = f"{generation}.robonomics.eth"
            self._own("robonomics.eth", generation, owner)
            self._own(root, "lighthouse", self.factory.address)
            for label, contract in (("xrt", self.xrt), ("factory", self.factory)):
                self._own(root, label, owner)
                self.send(self.resolver.functions.setAddr(namehash(f"{label}.{root}"), contract.address))

    def _own(self, parent: str, label: str, owner: str) -> None:
        node = namehash(parent) if parent else bytes(32)
        record = self.ens.functions.setSubnodeRecord(node, keccak256(label.encode()), owner, self.resolver.address, 0)
        self.send(record)
