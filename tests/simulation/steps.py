"""The invariants that must hold after each block, each match and each word to a person."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any, Final

from eth_utils.crypto import keccak

from mesh.agent.orders import OrderState
from mesh.chain import Finalized, NewLiability, Transfer
from schemas import ZERO_ADDRESS, Demand, InvalidMessage, InvalidRecord, Offer, Result, address_bytes, decode
from schemas.messages import lasting_hash, message_hash
from schemas.signing import Refusal, Rejection
from tests.simulation.attempts import AttemptAudit
from tests.simulation.scheduler import SECOND

if TYPE_CHECKING:
    from mesh.market import Match
    from tests.simulation.chain import PooledTransaction
    from tests.simulation.market import Market
    from tests.simulation.messages import Sample
    from tests.simulation.roles import PersonRole
    from tests.simulation.sessions import Session

BALANCE_OF: Final = keccak(text="balanceOf(address)")[:4].hex()
DEMAND_HASH: Final = keccak(text="demandHash()")[:4].hex()
UNSETTLED_NS: Final = 200 * SECOND
"""For how long after a reorganisation people may say what was so before it: their nodes' answers may be that old."""


class StepAudit:
    """Watches a market from its beginning."""

    def __init__(self, market: Market) -> None:
        self._market = market
        self._chain = market.deployed.chain
        deployment = market.deployed.market.deployment
        self._token = deployment.xrt
        holders = [account.address for account in market.deployed.accounts.values()]
        self._providers = {address_bytes(one.account.address) for one in market.providers}
        self._begin = {one: self._balance(one) for one in (*holders, deployment.factory, deployment.lighthouse)}
        self.liabilities: dict[str, str] = {}
        """Of each liability on the chain the demand's hash."""
        self.attempts = AttemptAudit(market, self, self._call)
        self._reorganisations = 0
        self.reorganised_ns = -UNSETTLED_NS
        """When the last one was."""
        self._forget()
        self.honoured: set[tuple[str, str]] = set()
        """Providers and the orders (hashes) of which they have said that they honour their withdrawal."""
        self.demands: dict[str, tuple[PersonRole, int]] = {}
        """All demands that were sent: by whom, as which of their orders."""
        self._makers: dict[str, tuple[PersonRole, int]] = {}
        """The same of all versions of a demand."""
        self.orders: dict[str, Sample] = {}
        """All orders (hashes) that were published."""
        self._verdicts: dict[tuple[str, str], tuple[str, bool]] = {}
        """What each juror has signed of each liability: result and success."""

    def _forget(self) -> None:
        self._before = self.liabilities
        self._read = self._chain.began
        self._expected: Counter[str] = Counter(self._begin)
        self.ended: dict[str, bool] = {}
        """Of each liability that has ended, whether with success."""
        self._payouts: dict[str, int] = defaultdict(int)
        self._submitted: set[tuple[bytes, bytes]] = set()
        """Senders and data of the providers' transactions that did what they wanted."""
        self.liabilities = {}

    def is_ended(self, liability: str) -> bool:
        """Whether a liability has ended on the chain."""
        return liability in self.ended

    def contracts_of(self, person: PersonRole) -> list[str]:
        """The liabilities of a person's demands."""
        return [
            liability
            for liability, demand in self.liabilities.items()
            if demand in self.demands and self.demands[demand][0] is person
        ]

    def block(self) -> None:
        """A block was mined, or some were replaced."""
        if self._chain.reorganisations != self._reorganisations:
            self._reorganisations = self._chain.reorganisations
            self.reorganised_ns = self._market.scheduler.now_ns
            self._forget()
        head = self._chain.evm.head
        self._listed()
        changed: set[str] = set()
        for event in self._chain.events(self._read + 1, head):
            if isinstance(event, NewLiability):
                self._created(event.liability)
            elif isinstance(event, Finalized):
                if event.liability in self.ended:
                    self._market.violated("finalized-twice", event.liability)
                self.ended[event.liability] = event.success
                self.attempts.ended(event.liability, success=event.success)
            elif isinstance(event, Transfer):
                self._moved(event)
                changed |= {event.sender, event.recipient}
        for number in range(self._read + 1, head + 1):
            self._mined(number)
        self._read = head
        for holder in sorted(changed - {ZERO_ADDRESS}):
            if self._balance(holder) != self._expected[holder]:
                detail = f"{holder} has {self._balance(holder)} and should have {self._expected[holder]} wn"
                self._market.violated("tokens-not-conserved", detail)

    def _mined(self, number: int) -> None:
        """No provider sends a transaction a second time that has had its effect; not checked after reorganisations."""
        for pooled in self._chain.mined.get(number, ()):
            if not self._reorganisations and pooled.sender in self._providers:
                self._sent_by_provider(pooled, number)

    def _sent_by_provider(self, pooled: PooledTransaction, number: int) -> None:
        sent = pooled.sender, self._chain.evm.read(pooled.raw).data
        if not sent[1]:  # it only uses a lost nonce up
            return
        if sent in self._submitted:
            self._market.violated("submitted-twice", f"by {pooled.sender.hex()} in block {number}")
        receipt = self._chain.evm.receipt(pooled.hash)
        if receipt is not None and int(receipt["status"], 16) == 1:
            self._submitted.add(sent)

    def _moved(self, event: Transfer) -> None:
        self._expected[event.sender] -= event.value
        self._expected[event.recipient] += event.value
        if event.sender in self.liabilities and event.value:
            self._payouts[event.sender] += 1
            if self._payouts[event.sender] > 1:
                self._market.violated("paid-twice", event.sender)

    def _created(self, liability: str) -> None:
        demand = self._call(liability, DEMAND_HASH).hex()
        self.liabilities[liability] = demand
        if demand not in self.demands:
            self._market.violated("unannounced-payment", f"{liability} is of a demand that was never sent")
            return
        person, number = self.demands[demand]
        order = person.orders[number]
        self.attempts.created(liability, demand)
        is_excused = order.told_ns < self.reorganised_ns + UNSETTLED_NS
        is_dead = order.is_dead and (not order.retry or demand in self.attempts.versions(order.order))
        if is_dead and (not is_excused or order.told == "nothing-found"):
            self._market.violated("promise-broken", f"{person.name} was told {order.told!r}; {liability}")
        self._check_withdrawn(liability, demand)
        versions = {one for one, maker in self.demands.items() if maker == (person, number)}
        # Before blocks were replaced; people may have restarted since.
        was_there = self._before.get(liability) == demand
        is_known = was_there or order.contract or versions & person.listed
        if person.agent_is_open and not order.is_over and not is_known:
            self._market.violated("unannounced-payment", f"{person.name}'s agent does not list {demand[:12]}")

    def _check_withdrawn(self, liability: str, demand: str) -> None:
        """The only provider makes no contract of an order whose withdrawal it honours."""
        is_promised = any((one.name, demand) in self.honoured for one in self._market.providers)
        is_alone = len(self._market.providers) == 1
        if is_promised and is_alone and liability not in self._before:
            self._market.violated("contract-after-withdrawal", f"{liability} is of the withdrawn {demand[:12]}")

    def told(self, person: PersonRole, number: int) -> None:
        """A person was told something of an order."""
        order = person.orders[number]
        order.told_ns, order.told_block = self._market.scheduler.now_ns, self._chain.evm.head
        if not order.is_dead or order.told_ns < self.reorganised_ns + UNSETTLED_NS:
            return
        mine = {demand for demand, maker in self.demands.items() if maker == (person, number)}
        if order.retry:
            mine &= self.attempts.versions(order.order)
        found = [liability for liability, demand in self.liabilities.items() if demand in mine]
        if found:
            self._market.violated("promise-broken", f"{person.name} is told {order.told!r}; {found[0]}")

    def _listed(self) -> None:
        """Note what agents list: what they name once, their people know."""
        for person in self._market.people:
            if person.agent_is_open and person.agent is not None:
                person.listed |= {order.hash for order in person.agent.orders(OrderState.OPEN, OrderState.WITHDRAWN)}

    def sent(self, sample: Sample, sender: Session) -> None:
        """A message was published."""
        role = next((one for one in self._market.roles if sender.process is one.process), None)
        if role is None or sender.process is None:
            return
        payload = sample.payload.to_bytes()
        if role in self._market.providers:
            try:
                rejection = Rejection.decode(payload)
            except InvalidRecord:
                return
            if rejection.reason == Refusal.WITHDRAWN:
                self.honoured.add((role.name, rejection.order))
            return
        try:
            message = decode(payload)
        except InvalidMessage:
            return
        if isinstance(message, Result) and role in self._market.jurors:
            verdict = message.result, message.success
            if self._verdicts.setdefault((role.name, message.liability), verdict) != verdict:
                self._market.violated("signed-twice", f"{role.name} signed another result of {message.liability}")
        if isinstance(message, Demand | Offer):
            self.orders.setdefault(message_hash(message).hex(), sample)
        if isinstance(message, Demand):
            self._demanded(role, message)

    def asked(self, key: str, payload: bytes, sender: Session) -> None:
        """A signed request was sent."""
        role = next((one for one in self._market.people if sender.process is one.process), None)
        if role is not None and (demand := self.attempts.asked(key, payload)) is not None:
            self._demanded(role, demand)

    def _demanded(self, role: Any, demand: Demand) -> None:
        """Somebody has sent a demand to the market, or to a provider."""
        identity = message_hash(demand).hex()
        if identity not in self.demands:
            person: PersonRole = role
            lasting = lasting_hash(demand)
            maker = self._makers.setdefault(lasting, (person, person.number_of(demand)))
            self.demands[identity] = maker
            self.attempts.sent(maker, identity, lasting)

    def matched(self, provider: str, match: Match) -> None:
        """A provider matched two orders."""
        for order in match:
            if (provider, order.hash.hex()) in self.honoured:
                self._market.violated("matched-after-withdrawal", order.hash.hex())

    def _balance(self, holder: str) -> int:
        return int.from_bytes(self._call(self._token, BALANCE_OF + holder[2:].lower().rjust(64, "0")))

    def _call(self, contract: str, data: str) -> bytes:
        answer: str = self._chain.answer("eth_call", [{"to": contract, "data": "0x" + data}, "latest"])
        return bytes.fromhex(answer[2:])
