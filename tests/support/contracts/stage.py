"""A market that histories are played on: the contracts, a foreign token, a jury, and people with little money."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from schemas import Demand, Offer, Result, address_bytes, checksum_address, keccak256, order_abi, parse_cid
from tests.support.contracts.books import UNLIMITED, Books, Terms
from tests.support.contracts.chains import py_evm
from tests.support.contracts.evm import Answer, Evm
from tests.support.contracts.market import MODEL, OBJECTIVE, OTHER, RESULT
from tests.support.contracts.suite import SUPPLY, XRT, Suite

if TYPE_CHECKING:
    from collections.abc import Sequence

PEOPLE: Final = 5
"""The first three are promisees and promisors, the third to the fifth providers, and the last one judges."""

FUNDS: Final = 40 * XRT
TIMEOUT: Final = 5
"""Blocks."""

FOREVER: Final = 10**9
"""A block that no history comes to."""

NEW_LIABILITY: Final = keccak256(b"NewLiability(address)")


@dataclass
class Work:
    """A liability, the orders it was made of, and how it ended if it has."""

    address: str
    terms: Terms
    orders: tuple[bytes, bytes]
    made_at: int
    ended: bool = False
    paid: bool = False


class Stage:
    """The market as it is at the beginning of every history, and the calls that people make."""

    def __init__(self) -> None:
        suite = Suite(py_evm())
        self.xrt, self.factory = str(suite.xrt.address), str(suite.factory.address)
        self.people = tuple(person.address for person in suite.people[1 : 1 + PEOPLE])
        self.judge = self.people[-1]
        self.keeper = suite.deployer.address
        self.lighthouse = str(suite.create_lighthouse(timeout=TIMEOUT).address)
        foreign, jury = suite.deploy("BlockingToken", PEOPLE * FUNDS), suite.deploy("Jury", self.xrt, [self.judge], 1)
        self.foreign, self.jury = str(foreign.address), str(jury.address)
        for person in suite.people[1 : 1 + PEOPLE]:
            suite.fund(person, FUNDS, self.factory)
            suite.send(suite.xrt.functions.approve(self.factory, UNLIMITED), person)
            suite.send(suite.xrt.functions.approve(self.lighthouse, UNLIMITED), person)
            suite.send(foreign.functions.transfer(person.address, FUNDS))
        self.signers = {person.address: person.signer for person in suite.people}
        self.holders = (*self.people, self.keeper, self.factory, self.lighthouse, self.jury)
        self.foreign_supply = PEOPLE * FUNDS
        self.evm = Evm(suite.chain)
        self._places = {
            (token, holder): _place_of_balance(holder, slot)
            for token, slot in ((self.xrt, 1), (self.foreign, 0))
            for holder in self.holders
        }

    def begin(self) -> Books:
        """Back to the beginning, and the books as they are then."""
        self.evm.rewind()
        self._nonces = count(1)
        balances = {(token, holder): 0 for token in (self.xrt, self.foreign) for holder in self.holders}
        balances |= {(token, person): FUNDS for token in (self.xrt, self.foreign) for person in self.people}
        balances[self.xrt, self.keeper] = SUPPLY - PEOPLE * FUNDS
        allowances = dict.fromkeys(self.people, UNLIMITED)
        return Books(self.xrt, self.factory, self.lighthouse, XRT, balances, SUPPLY, allowances)

    def balance(self, token: str, holder: str) -> int:
        """The balance of an account, as the token returns it."""
        return self.ask(token, "balanceOf(address)", holder)

    def allowance(self, owner: str) -> int:
        """The allowance that an account gave the factory, as XRT returns it."""
        return self.ask(self.xrt, "allowance(address,address)", owner, self.factory)

    def stored_balance(self, token: str, holder: str) -> int:
        """The same as it lies in the token's storage, for looking often."""
        return self.evm.stored(token, self._places[token, holder])

    def current_provider(self) -> str:
        """The current provider; without any, the first account that may become one."""
        current = self.evm.call(self.lighthouse, "current()", sender=self.keeper).output[12:]
        return checksum_address(current) if any(current) else self.people[2]

    def ask(self, target: str, function: str, *arguments: Any) -> int:
        """A number, or a truth as 0 or 1, that a contract answers."""
        answer = self.evm.call(target, function, *arguments, sender=self.keeper)
        assert answer.refusal is None
        return answer.number

    def orders(self, terms: Terms, *, deadline: int, offered: int) -> tuple[bytes, bytes]:
        """Demand and offer for these terms, signed; the offer is for the cost `offered`."""
        shared: dict[str, Any] = {
            "model": MODEL,
            "objective": OBJECTIVE,
            "token": terms.token,
            "lighthouse": self.lighthouse,
            "validator": terms.validator,
            "deadline": deadline,
        }
        first, second = self._mark(terms, terms.promisee), self._mark(terms, terms.promisor)
        if terms.generation == 5 and terms.promisee == terms.promisor:
            second["nonce"] += 1
        demand = Demand(cost=terms.cost, validator_fee=terms.validator_fee, **shared, **first)
        offer = Offer(cost=offered, lighthouse_fee=terms.lighthouse_fee, **shared, **second)
        demand, offer = self.signers[terms.promisee].sign(demand), self.signers[terms.promisor].sign(offer)
        return order_abi(demand), order_abi(offer)

    def create(self, orders: tuple[bytes, bytes], provider: str) -> tuple[Answer, str]:
        """Make a liability; its address is empty if it was refused."""
        answer = self.evm.call(self.lighthouse, "createLiability(bytes,bytes)", *orders, sender=provider)
        made = [topics[1] for emitter, topics in answer.logs if emitter == self.factory and topics[0] == NEW_LIABILITY]
        return answer, checksum_address(made[0][12:]) if made else ""

    def finish(self, work: Work, success: bool, signer: str, provider: str, *, altered: bool) -> Answer:
        """End a liability through the lighthouse; an altered result is another than the one that was signed."""
        result, signature = self._result(work, success, signer, altered)
        finalize = "finalizeLiability(address,bytes,bool,bytes)"
        return self.evm.call(self.lighthouse, finalize, work.address, result, success, signature, sender=provider)

    def finish_without_turn(self, work: Work, success: bool, signer: str, caller: str, *, altered: bool) -> Answer:
        """End a liability as anybody can."""
        result, signature = self._result(work, success, signer, altered)
        finalize = "finalize(address,bytes,bool,bytes)"
        return self.evm.call(self.factory, finalize, work.address, result, success, signature, sender=caller)

    def judge_result(
        self, work: Work, verdict: tuple[bool, bool], signer: str, caller: str, *, altered: bool
    ) -> Answer:
        """End a liability of generation 3 as its validator does; the verdict is success and agreement."""
        result, signature = self._result(work, verdict[0], signer, altered)
        finalize = "finalize(bytes,bool,bytes,bool)"
        return self.evm.call(work.address, finalize, result, verdict[0], signature, verdict[1], sender=caller)

    def refund(self, work: Work, caller: str) -> Answer:
        """Ask for the promisee's money after the delay."""
        return self.evm.call(self.factory, "refund(address)", work.address, sender=caller)

    def cancel(self, work: Work, signers: Sequence[str], caller: str) -> Answer:
        """End a liability with the signatures of these two as promisee's and promisor's."""
        digest = keccak256(address_bytes(work.address) + b"cancel")
        signatures = [self.signers[signer].sign_hash(digest) for signer in signers]
        return self.evm.call(self.factory, "cancel(address,bytes,bytes)", work.address, *signatures, sender=caller)

    def stake(self, function: str, value: int, provider: str) -> Answer:
        """Refill or withdraw."""
        return self.evm.call(self.lighthouse, function, value, sender=provider)

    def approve(self, value: int, owner: str) -> Answer:
        """Approve the factory for an amount of an account's XRT."""
        return self.evm.call(self.xrt, "approve(address,uint256)", self.factory, value, sender=owner)

    def block(self, person: str, *, is_blocked: bool, way: int) -> None:
        """Put a person on the foreign token's blocklist, or take it off; `way` is how it refuses to pay from now on."""
        for function, values in (("setBlocked(address,bool)", (person, is_blocked)), ("setRefusal(uint8)", (way,))):
            assert self.evm.call(self.foreign, function, *values, sender=self.keeper).refusal is None

    def claim(self, account: str, caller: str) -> Answer:
        """Have an account paid what it is owed in the foreign token."""
        return self.evm.call(self.factory, "claim(address,address)", self.foreign, account, sender=caller)

    def claim_to(self, account: str, to: str) -> Answer:
        """Have what an account is owed in the foreign token paid to another one."""
        return self.evm.call(self.factory, "claimTo(address,address)", self.foreign, to, sender=account)

    def owed(self, account: str) -> int:
        """Units of the foreign token that an account is owed."""
        return self.ask(self.factory, "owed(address,address)", self.foreign, account)

    def collect_fees(self) -> Answer:
        """Take the jury's fees out of it."""
        fees = self.balance(self.xrt, self.jury)
        return self.evm.call(self.jury, "collect(uint256)", fees, sender=self.keeper)

    def _result(self, work: Work, success: bool, signer: str, altered: bool) -> tuple[bytes, bytes]:
        signed = Result(liability=work.address, result=OTHER if altered else RESULT, success=success)
        return parse_cid(RESULT), bytes.fromhex(self.signers[signer].sign(signed).signature)

    def _mark(self, terms: Terms, person: str) -> dict[str, Any]:
        """What makes an order the only one of its kind."""
        if terms.generation == 3:
            return {"nonce": f"{2**255 + next(self._nonces):064x}"}
        return {"nonce": self.ask(self.factory, "nonceOf(address)", person), "sender": person}


def _place_of_balance(holder: str, slot: int) -> int:
    """Where Solidity keeps the value of an address in the mapping at `slot`."""
    return int.from_bytes(keccak256(bytes(12) + address_bytes(holder) + slot.to_bytes(32, "big")), "big")
