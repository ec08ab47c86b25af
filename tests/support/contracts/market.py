"""Orders and results for tests: the messages of both generations, signed, as the contracts take them."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any, Final

from web3.logs import DISCARD

from schemas import ZERO_ADDRESS, Demand, Offer, Permit, Result, cid_of_digest, message_hash, order_abi, parse_cid
from tests.support.contracts.suite import XRT, Person, Suite

if TYPE_CHECKING:
    from web3.contract import Contract
    from web3.types import TxReceipt

MODEL: Final = cid_of_digest(bytes.fromhex("11" * 32))
OBJECTIVE: Final = cid_of_digest(bytes.fromhex("22" * 32))
RESULT: Final = cid_of_digest(bytes.fromhex("33" * 32))
OTHER: Final = cid_of_digest(bytes.fromhex("44" * 32))

FUNDS: Final = 1000 * XRT
QUOTA: Final = 1000
FINALIZE: Final = "finalize"


def permit_arguments(permit: Permit) -> tuple[int, int, int, bytes, bytes]:
    """Value, deadline and signature, as contracts take them."""
    signature = bytes.fromhex(permit.signature)
    return permit.value, permit.deadline, signature[64], signature[:32], signature[32:64]


class Market:
    """One generation's way through the contracts: a lighthouse with a provider, a promisee and a promisor with XRT."""

    def __init__(self, suite: Suite, generation: int) -> None:
        self.suite = suite
        self.generation = generation
        self.provider, self.promisee, self.promisor, self.outsider = suite.people[1:5]
        self.lighthouse = suite.create_lighthouse()
        suite.join(self.lighthouse, self.provider, QUOTA * XRT)
        for person in (self.promisee, self.promisor):
            suite.fund(person, FUNDS, suite.factory.address)
        self._nonces = count(1)

    def demand(self, *, by: Person | None = None, ahead: int = 0, **changes: Any) -> Demand:
        """The promisee's signed order; `ahead` orders of the same signer are used before it."""
        person = by or self.promisee
        fields = {**self._work(person, ahead), "validator_fee": 0, **changes}
        return person.signer.sign(Demand(**fields))

    def offer(self, *, by: Person | None = None, ahead: int = 0, **changes: Any) -> Offer:
        """The promisor's signed order."""
        person = by or self.promisor
        fields = {**self._work(person, ahead), "lighthouse_fee": 0, **changes}
        return person.signer.sign(Offer(**fields))

    def pair(self, **changes: Any) -> tuple[Demand, Offer]:
        """A demand and an offer that match, both with these changes; each gets the fee that it has a field for."""
        validator_fee, lighthouse_fee = changes.pop("validator_fee", 0), changes.pop("lighthouse_fee", 0)
        return self.demand(validator_fee=validator_fee, **changes), self.offer(lighthouse_fee=lighthouse_fee, **changes)

    def creation(self, demand: Demand | bytes, offer: Offer | bytes, lighthouse: Contract | None = None) -> Any:
        """The call that makes a liability; bytes are taken as they are."""
        orders = (order if isinstance(order, bytes) else order_abi(order) for order in (demand, offer))
        return (lighthouse or self.lighthouse).functions.createLiability(*orders)

    def permit(self, value: int, *, by: Person | None = None, token: Contract | None = None, **changes: Any) -> Permit:
        """The promisee's signed permit for the factory; `token` is XRT by default."""
        owner, token = by or self.promisee, token or self.suite.xrt
        fields = {
            "owner": owner.address,
            "spender": self.suite.factory.address,
            "token": token.address,
            "value": value,
            "nonce": token.functions.nonces(owner.address).call(),
            "deadline": self.suite.web3.eth.get_block("latest")["timestamp"] + 3600,
            "domain": token.functions.DOMAIN_SEPARATOR().call().hex(),
        }
        return owner.signer.sign(Permit(**{**fields, **changes}))

    def permitted_creation(self, demand: Demand, offer: Offer, permit: Permit, at: Contract | None = None) -> Any:
        """The call that makes a liability with the promisee's permit."""
        functions = (at or self.lighthouse).functions
        return functions.createLiabilityWithPermit(order_abi(demand), order_abi(offer), *permit_arguments(permit))

    def permission(self, permit: Permit) -> Any:
        """The call by which anybody brings a permit to its token."""
        token = self.suite.contract("XRT", permit.token)
        return token.functions.permit(permit.owner, permit.spender, *permit_arguments(permit))

    def create(self, **changes: Any) -> Contract:
        """A liability on matching orders with these changes."""
        return self.liability_of(self.suite.send(self.creation(*self.pair(**changes)), self.provider))

    def liability_of(self, receipt: TxReceipt) -> Contract:
        """The liability that a transaction made."""
        (event,) = self.suite.factory.events.NewLiability().process_receipt(receipt, errors=DISCARD)
        return self.suite.contract("Liability", event["args"]["liability"])

    def withdrawal(self, order: Demand | Offer) -> Any:
        """The call by which the order's maker makes it unusable."""
        functions = self.suite.factory.functions
        if order.generation == 3:
            return functions.withdrawOrder(message_hash(order))
        return functions.withdrawNonce(int(order.nonce))

    def result(self, liability: Contract, *, success: bool = True, by: Person | None = None) -> Result:
        """A signed result, by default the promisor's."""
        message = Result(liability=liability.address, result=RESULT, success=success)
        return (by or self.promisor).signer.sign(message)

    def finalization(self, result: Result, lighthouse: Contract | None = None) -> Any:
        """The call by which this generation's providers end a liability."""
        called = lighthouse or self.lighthouse
        data, signature = parse_cid(result.result), bytes.fromhex(result.signature)
        if self.generation == 5:
            return called.functions.finalizeLiability(result.liability, data, result.success, signature)
        liability = self.suite.contract("Liability", result.liability)
        carried = liability.encode_abi(FINALIZE, [data, result.success, signature, True])
        return called.functions.to(result.liability, carried)

    def verdict(self, liability: Contract, *jurors: Person, success: bool = True) -> Any:
        """The call by which a provider ends a liability with one result that several have signed, in that order."""
        results = [self.result(liability, success=success, by=juror) for juror in jurors]
        signatures = bytes.fromhex("".join(result.signature for result in results))
        return self.lighthouse.functions.finalizeLiability(liability.address, parse_cid(RESULT), success, signatures)

    def finalization_without_turn(self, result: Result) -> Any:
        """The call by which anybody ends a liability."""
        data, signature = parse_cid(result.result), bytes.fromhex(result.signature)
        return self.suite.factory.functions.finalize(result.liability, data, result.success, signature)

    def finalize(self, liability: Contract, *, success: bool = True) -> TxReceipt:
        """End a liability with the promisor's result."""
        return self.suite.send(self.finalization(self.result(liability, success=success)), self.provider)

    def refusal(self, call: Any, sender: Person | None = None) -> tuple[Any, ...]:
        """Why a call of the provider's (or another's) is refused; empty if it is not."""
        return self.suite.chain.refusal(call, (sender or self.provider).address)

    def _work(self, person: Person, ahead: int) -> dict[str, Any]:
        fields: dict[str, Any] = {
            "model": MODEL,
            "objective": OBJECTIVE,
            "token": self.suite.xrt.address,
            "cost": 0,
            "lighthouse": self.lighthouse.address,
            "validator": ZERO_ADDRESS,
            "deadline": 10**6,
        }
        if self.generation == 3:
            return {**fields, "nonce": (2**255 + next(self._nonces)).to_bytes(32, "big").hex()}
        nonce = self.suite.factory.functions.nonceOf(person.address).call() + ahead
        return {**fields, "nonce": nonce, "sender": person.address}
