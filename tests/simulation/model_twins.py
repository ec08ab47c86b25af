"""The contracts on the embedded EVM and their model side by side, with the same accounts and addresses."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from eth.vm.message import Message
from eth_abi.abi import encode

from mesh.chain import XRT, Account
from mesh.chain._names import namehash
from mesh.chain._node import Node
from mesh.chain.deploy import DeploymentPlan
from mesh.chain.transactions import TransactionSender
from mesh.dev._evm import Methods
from mesh.dev._rpc import RpcError
from mesh.dev.development import deploy_market
from schemas import Signer, address_bytes
from tests.simulation.chain import EvmChain
from tests.simulation.model import ModelChain
from tests.simulation.model_abi import ModelRevert, artifact, functions
from tests.simulation.model_abi import encode as encode_words
from tests.simulation.model_state import ModelRun

if TYPE_CHECKING:
    from mesh.dev._evm import Evm

GAS: Final = 8_000_000
REFUND_DELAY: Final = 12
TIMEOUT: Final = 4
PEOPLE: Final = 6
JURY: Final = ["address", "address[]", "uint256"]
"""What its constructor takes."""
PLAN: Final = DeploymentPlan(timeout_blocks=TIMEOUT, refund_delay=REFUND_DELAY)


class Outcome(NamedTuple):
    """What a call did."""

    succeeded: bool
    data: bytes
    logs: list[tuple[bytes, list[bytes], bytes]]


class NodeOf:
    """A node that answers at once."""

    def __init__(self, evm: Any) -> None:
        self.methods = Methods(evm)

    async def make_request(self, method: Any, params: Any) -> Any:
        """A JSON-RPC response."""
        try:
            return {"jsonrpc": "2.0", "id": 0, "result": self.methods.answer(method, params)}
        except RpcError as error:
            return {"jsonrpc": "2.0", "id": 0, "error": error.as_object()}


class Twins:
    """A market, deployed on both; then calls change both, and `begin` goes back."""

    def __init__(self) -> None:
        self.evm = EvmChain()
        self.model = ModelChain(self.evm.funded_keys)
        self.signers = [Signer(key) for key in self.evm.funded_keys[:PEOPLE]]
        self.people = [address_bytes(signer.address) for signer in self.signers]
        self.addresses = asyncio.run(self._deploy(self.evm))
        assert asyncio.run(self._deploy(self.model)) == self.addresses
        assert self.evm.head == self.model.head
        self._chain: Any = self.evm._backend.chain
        self.begin()

    def begin(self) -> None:
        """Go back to the market as it was deployed."""
        self._vm: Any = self._chain.get_vm()
        self._state: Any = self._vm.state
        self.model._state.rewind(self.model.head)
        self.height = self.model.head

    def call(
        self, sender: bytes, to: bytes, data: bytes, *, value: int = 0, keep: bool = True
    ) -> tuple[Outcome, Outcome]:
        """Call on both, in a block of its own; what the EVM and the model did. Without `keep` it is undone."""
        mark = self._state.snapshot()
        found = self._on_evm(sender, to, data, value), self._on_model(sender, to, data, value, keep=keep)
        if keep:
            self.pass_blocks(1)
        else:
            self._state.revert(mark)
        return found

    def pass_blocks(self, blocks: int) -> None:
        """Let blocks pass."""
        self.height += blocks
        header = self._vm.get_header().copy(block_number=self.height + 1)
        self._state.execution_context = self._vm.create_execution_context(header, [], self._vm.chain_context)

    def code(self, address: bytes) -> tuple[bytes, bytes]:
        """The code on both."""
        return bytes(self._state.get_code(address)), self._run().code(address)

    def _run(self) -> ModelRun:
        return ModelRun(self.model._state, self.height, self.model.chain_id)

    def _on_evm(self, sender: bytes, to: bytes, data: bytes, value: int) -> Outcome:
        code = self._state.get_code(to)
        message = Message(gas=GAS, to=to, sender=sender, value=value, data=data, code=code)  # type: ignore[arg-type]
        context = self._state.get_transaction_context_class()(gas_price=0, origin=sender)
        done = self._state.computation_class.apply_message(self._state, message, context)
        if done.is_error:
            return Outcome(False, bytes(done.output), [])
        logs = [
            (bytes(emitter), [topic.to_bytes(32, "big") for topic in topics], bytes(data))
            for emitter, topics, data in done.get_log_entries()
        ]
        return Outcome(True, bytes(done.output), logs)

    def _on_model(self, sender: bytes, to: bytes, data: bytes, value: int, *, keep: bool) -> Outcome:
        run = self._run()
        try:
            returned = run.call(sender, to, data, value=value)
        except ModelRevert as error:
            return Outcome(False, error.data, [])
        if keep:
            self.model._state.apply(self.height + 1, run.writes)
        return Outcome(True, returned, run.logs)

    async def _deploy(self, evm: Evm | ModelChain) -> dict[str, bytes]:
        """The market of `mesh.dev`, and more providers, another token and a jury."""
        endpoint = NodeOf(evm)
        market = await deploy_market(endpoint, evm.funded_keys, plan=PLAN)
        found = market.deployment
        names = ("ens", "resolver", "xrt", "factory", "lighthouse")
        addresses = {name: address_bytes(getattr(found, name)) for name in names}
        async with Node(endpoint) as node:
            sender = TransactionSender(node, Account(evm.funded_keys[0]))
            token = node.contract("XRT", found.xrt)
            for key in evm.funded_keys[3:PEOPLE]:
                await sender.call(token.transfer(Signer(key).address, 30 * XRT))
            for key in evm.funded_keys[:PEOPLE]:
                each = TransactionSender(node, Account(key))
                for spender in (found.factory, found.lighthouse):
                    await each.call(token.approve(spender, 1000 * XRT))
            jurors = sorted((Signer(key).address for key in evm.funded_keys[3:PEOPLE]), key=address_bytes)
            arguments: dict[str, tuple[str, list[str], list[Any]]] = {
                "other": ("XRT", ["uint256"], [500 * XRT]),
                "blocking": ("BlockingToken", ["uint256"], [500 * XRT]),
                "jury": ("Jury", JURY, [found.xrt, jurors[-1:], 1]),
                "panel": ("Jury", JURY, [found.xrt, jurors, 2]),
            }
            for name, (kind, types, values) in arguments.items():
                data = bytes.fromhex(artifact(kind)["bytecode"][2:]) + encode(types, values)
                receipt = await sender.send(to=None, data=data)
                assert receipt.contract is not None
                addresses[name] = address_bytes(receipt.contract)
                if name == "blocking":
                    for promisee in self.signers[1:3]:
                        await sender.call(node.contract("XRT", receipt.contract).transfer(promisee.address, 200 * XRT))
        return addresses


def call_of(kind: str, name: str, *values: Any) -> bytes:
    """The data of a call."""
    selector, function = next((key, one) for key, one in functions(kind).items() if one.name == name)
    return selector + encode_words(function.inputs, values)


def reads(kind: str, accounts: list[bytes], hashes: list[bytes]) -> list[bytes]:
    """Calls of all view functions of a contract."""
    people, found = accounts[:PEOPLE], []
    pools: dict[tuple[str, ...], list[tuple[Any, ...]]] = {
        (): [()],
        ("address",): [(account,) for account in accounts],
        ("uint256",): [(number,) for number in (0, 1, 2, 2**255)],
        ("bytes32",): [(digest,) for digest in (*hashes[:4], namehash("eth"), namehash("factory.3.robonomics.eth"))],
        ("bytes4",): [(bytes.fromhex("3b3b57de"),), (bytes(4),)],
        ("bytes32", "address"): [(digest, account) for digest in hashes[-4:] for account in people[1:4]],
        ("address", "address"): [
            *[(owner, spender) for owner in people for spender in accounts[-3:]],
            *[(token, account) for token in accounts[PEOPLE:] for account in people[1:4]],
        ],
        ("address", "uint256"): [(bytes(20), 10), (bytes(20), 1), (people[3], 2), (people[0], 0)],
    }
    for entry in artifact(kind)["abi"]:
        if entry["type"] == "function" and entry["stateMutability"] in ("view", "pure"):
            types = tuple(member["type"] for member in entry["inputs"])
            found += [call_of(kind, entry["name"], *values) for values in pools[types]]
    return found
