"""A token that refuses to pay one account: all others are paid at once, and that account later."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING, Any, Final

import pytest
from web3.logs import DISCARD

from schemas import keccak256, parse_cid
from tests.support.contracts.juries import Panel
from tests.support.contracts.market import RESULT, Market
from tests.support.contracts.suite import REFUND_DELAY, XRT, Suite

if TYPE_CHECKING:
    from collections.abc import Callable

    from web3.contract import Contract
    from web3.types import TxReceipt

    from tests.support.contracts.chains import Chain
    from tests.support.contracts.suite import Person

pytestmark = pytest.mark.sample("market", "refusal")

COST: Final = 1000
FEE: Final = 7
REFUSALS: Final = ("reverts", "returns false", "burns gas", "returns much")
ATTEMPT_GAS: Final = 300_000
"""What the factory gives each payment."""


class Job:
    """A liability that is paid in a token with a blocklist, and judged for a fee in XRT if it has a validator."""

    def __init__(self, market: Market, *, judged: bool = False, token: Contract | None = None) -> None:
        self.market, self.suite = market, market.suite
        self.token = token or self.suite.deploy("BlockingToken", 10 * COST)
        self.suite.send(self.token.functions.transfer(market.promisee.address, COST))
        self.jury = Panel(self.suite, quorum=1, size=1) if judged and market.generation == 5 else None
        terms: dict[str, Any] = {"token": self.token.address, "cost": COST}
        if judged:
            validator = self.jury.address if self.jury else market.outsider.address
            terms |= {"validator": validator, "validator_fee": FEE}
        self.terms = terms
        self.liability = market.create(**terms)

    def block(self, person: Person, *, blocked: bool = True) -> None:
        self.suite.send(self.token.functions.setBlocked(person.address, blocked))

    def finalization(self, *, success: bool) -> tuple[Any, Person]:
        """The call that ends it with a result, and who may send it."""
        if self.jury:
            return self.market.verdict(self.liability, *self.jury.jurors, success=success), self.market.provider
        result = self.market.result(self.liability, success=success)
        if "validator" in self.terms:
            signature = bytes.fromhex(result.signature)
            call = self.liability.functions.finalize(parse_cid(RESULT), success, signature, True)
            return call, self.market.outsider
        return self.market.finalization(result), self.market.provider

    def succeeds(self) -> TxReceipt:
        call, sender = self.finalization(success=True)
        return self.suite.send(call, sender)

    def fails(self) -> TxReceipt:
        call, sender = self.finalization(success=False)
        return self.suite.send(call, sender)

    def is_refunded(self) -> TxReceipt:
        self.suite.chain.mine(REFUND_DELAY)
        return self.suite.send(self.suite.factory.functions.refund(self.liability.address))

    def is_cancelled(self) -> TxReceipt:
        hash_ = keccak256(bytes.fromhex(self.liability.address[2:]) + b"cancel")
        signatures = [person.signer.sign_hash(hash_) for person in (self.market.promisee, self.market.promisor)]
        return self.suite.send(self.suite.factory.functions.cancel(self.liability.address, *signatures))

    def held(self, person: Person | Contract) -> int:
        """What an account has of the token."""
        return int(self.token.functions.balanceOf(person.address).call())

    def owed(self, person: Person) -> int:
        return int(self.suite.factory.functions.owed(self.token.address, person.address).call())

    def claim(self, person: Person) -> Any:
        return self.suite.factory.functions.claim(self.token.address, person.address)

    def claim_to(self, person: Person) -> Any:
        return self.suite.factory.functions.claimTo(self.token.address, person.address)


ENDS: Final[dict[str, tuple[Callable[[Job], TxReceipt], bool]]] = {
    "success": (Job.succeeds, True),
    "failure": (Job.fails, True),
    "refund": (Job.is_refunded, False),
    "cancellation": (Job.is_cancelled, False),
}
"""How a job ends, and whether its validator is paid then."""


@pytest.mark.parametrize("refusal", REFUSALS)
@pytest.mark.parametrize("blocked", ["promisee", "promisor"])
@pytest.mark.parametrize("end", ENDS)
def test_every_end_pays_those_whom_the_token_pays_and_owes_the_others(
    market: Market, end: str, blocked: str, refusal: str
) -> None:
    job = Job(market, judged=True)
    suite, end_it, judged = market.suite, *ENDS[end]
    receiver = market.promisor if end == "success" else market.promisee
    validator = job.terms["validator"]
    wn = {who: suite.xrt.functions.balanceOf(who).call() for who in (validator, market.promisee.address)}
    suite.send(job.token.functions.setRefusal(REFUSALS.index(refusal)))
    person = getattr(market, blocked)
    job.block(person)

    receipt = end_it(job)

    assert job.liability.functions.isFinalized().call()
    assert job.liability.functions.isSuccess().call() == (end == "success")
    paid_fee = validator if judged else market.promisee.address
    assert suite.xrt.functions.balanceOf(paid_fee).call() == wn[paid_fee] + FEE
    owed = COST if person is receiver else 0
    assert (job.owed(receiver), job.held(receiver), job.held(suite.factory)) == (owed, COST - owed, owed)
    events = suite.factory.events.PaymentRefused().process_receipt(receipt, errors=DISCARD)
    wanted = {"token": job.token.address, "account": receiver.address, "value": COST}
    assert [dict(event["args"]) for event in events] == ([wanted] if owed else [])

    if owed:
        job.block(person, blocked=False)
        suite.send(job.claim(receiver), market.outsider)
    assert (job.owed(receiver), job.held(receiver), job.held(suite.factory)) == (0, COST, 0)


def test_an_account_that_stays_blocked_claims_to_another_one(market: Market) -> None:
    job = Job(market)
    suite, another = market.suite, market.suite.people[9]
    job.block(market.promisee)
    job.fails()
    assert market.refusal(job.claim(market.promisee)) == ("",)  # the token's own error
    assert market.refusal(job.claim_to(another), market.outsider)[0] == "NothingOwed"

    receipt = suite.send(job.claim_to(another), market.promisee)

    assert (job.owed(market.promisee), job.held(another), job.held(suite.factory)) == (0, COST, 0)
    (event,) = suite.factory.events.Claimed().process_receipt(receipt, errors=DISCARD)
    assert dict(event["args"]) == {
        "token": job.token.address,
        "account": market.promisee.address,
        "to": another.address,
        "value": COST,
    }


def test_what_several_jobs_owe_is_claimed_together(market: Market) -> None:
    job = Job(market)
    jobs = [job, Job(market, token=job.token)]
    job.block(market.promisee)
    for each in jobs:
        each.fails()
    assert job.owed(market.promisee) == 2 * COST
    job.block(market.promisee, blocked=False)
    Job(market, token=job.token)
    market.suite.send(job.claim(market.promisee), market.outsider)
    # What the open liability costs is still there.
    assert (job.held(market.promisee), job.held(market.suite.factory)) == (2 * COST, COST)
    nothing = "NothingOwed", job.token.address, market.promisee.address
    assert market.refusal(job.claim(market.promisee)) == nothing


def test_a_token_that_calls_back_pays_a_claim_once(market: Market) -> None:
    job = Job(market, token=market.suite.deploy("HeavyToken", 10 * COST, 2 * ATTEMPT_GAS))
    job.succeeds()
    Job(market, token=job.token)
    again = market.suite.factory.encode_abi("claim", [job.token.address, market.promisor.address])
    market.suite.send(job.token.functions.setHook(market.suite.factory.address, again))

    market.suite.send(job.claim(market.promisor), market.outsider)

    assert not job.token.functions.called().call()
    assert job.token.functions.answer().call()[:4] == keccak256(b"NothingOwed(address,address)")[:4]
    assert (job.held(market.promisor), job.held(market.suite.factory)) == (COST, COST)


def test_a_claim_that_the_token_refuses_changes_nothing(market: Market) -> None:
    job = Job(market)
    job.block(market.promisee)
    job.fails()
    market.suite.send(job.token.functions.setRefusal(REFUSALS.index("returns false")))
    assert market.refusal(job.claim(market.promisee)) == ("TokenTransferFailed", job.token.address)
    assert (job.owed(market.promisee), job.held(market.suite.factory)) == (COST, COST)


def test_only_the_factory_itself_makes_an_attempt(market: Market) -> None:
    job = Job(market)
    attempt = market.suite.factory.functions.pay(job.token.address, market.outsider.address, COST)
    assert market.refusal(attempt, market.outsider) == ("NotTheFactory", market.outsider.address)


@pytest.mark.sample("needed")
@pytest.mark.parametrize("needed", [30_000, 200_000, 280_000])
def test_no_gas_limit_makes_a_good_payment_a_refused_one(market: Market, needed: int) -> None:
    job = Job(market, token=market.suite.deploy("HeavyToken", 10 * COST, needed))
    suite, (call, sender) = market.suite, job.finalization(success=True)
    enough = call.estimate_gas({"from": sender.address})
    seen = set()
    for limit in count(60_000, 15_000):
        before = suite.chain.snapshot()
        status = _sent(suite, call, sender, limit)["status"]
        assert job.owed(market.promisor) == 0
        assert (job.held(market.promisor) == COST) == status
        seen.add(status)
        suite.chain.revert(before)
        if limit > enough + 150_000:
            break
    assert seen == {0, 1}
    assert _sent(suite, call, sender, enough)["status"] == 1


@pytest.mark.parametrize("refusal", REFUSALS)
def test_an_estimate_is_enough_for_a_refused_payment_and_no_limit_loses_it(market: Market, refusal: str) -> None:
    job = Job(market, judged=True)
    suite = market.suite
    suite.send(job.token.functions.setRefusal(REFUSALS.index(refusal)))
    job.block(market.promisee)
    call, sender = job.finalization(success=False)
    enough = call.estimate_gas({"from": sender.address})
    for limit in range(100_000, enough + 100_000, 20_000):
        before = suite.chain.snapshot()
        status = _sent(suite, call, sender, limit)["status"]
        assert job.owed(market.promisee) == (COST if status else 0)
        suite.chain.revert(before)
    receipt = _sent(suite, call, sender, enough)
    assert receipt["status"] == 1
    assert job.owed(market.promisee) == COST
    # The token takes no more than an attempt has, whatever it does.
    assert receipt["gasUsed"] < 200_000 + ATTEMPT_GAS * (refusal in ("burns gas", "returns much"))


def test_a_token_that_needs_more_gas_than_an_attempt_has_pays_at_the_claim(market: Market) -> None:
    job = Job(market, token=market.suite.deploy("HeavyToken", 10 * COST, 2 * ATTEMPT_GAS))
    job.succeeds()
    assert (job.owed(market.promisor), job.held(market.promisor)) == (COST, 0)
    market.suite.send(job.claim(market.promisor), market.outsider)
    assert (job.owed(market.promisor), job.held(market.promisor)) == (0, COST)


@pytest.mark.parametrize("generation", [3, 5])
def test_a_result_is_taken_when_no_more_xrt_can_be_made(chain: Chain, undone: None, generation: int) -> None:
    most = 2**96 - 1
    market = Market(Suite(chain, supply=most - 5), generation)
    before = market.suite.balance(market.provider)
    for _ in range(2):
        market.finalize(market.create(cost=XRT))
    assert market.suite.balance(market.provider) == before + 5
    assert market.suite.xrt.functions.totalSupply().call() == most


def _sent(suite: Suite, call: Any, sender: Person, limit: int) -> TxReceipt:
    """The receipt of a transaction with this gas limit."""
    sent = call.transact({"from": sender.address, "gas": limit})
    return suite.web3.eth.wait_for_transaction_receipt(sent, poll_latency=0.005)
