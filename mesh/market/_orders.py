"""The orders and results at a provider: one record of each, with one state. Pure: no I/O.

                 ┌───────────────────────────────────────────────────────────────┐
                 ▼                                                               │ its contract was reverted
    received ──► open ──► matched ──► sending ──► mined ──► confirmed ──► (forgotten)
      ▲   │       │          │           │          ▲            ▲
      │   └─► unfunded       │           │          └─ matched   └─ another provider's contract, of whatever is open
      │           │          │           │
      └───────────┴──────────┴───────────┘ looked at again: its maker can pay, or its transaction was not mined

    whatever is not mined may end as: withdrawn, replaced, expired, refused

`received` is before the record: messages that wait to be looked at stand in the provider's arrivals. A result has no
book: it is received while it waits for those of other jurors, then matched (with its contract), sending, mined,
confirmed. The record of an order is dropped when it ends; that it was withdrawn, or became a contract, is remembered by
`Withdrawals` and `OrderVersions`, which know orders that this provider has never seen, too.

Versions of an order (generation 5) differ in their nonce only: when another order of an account has used a nonce, the
account signs its open orders with that nonce again. A reorganisation may free the nonce: then the older version would
be valid again, and after it the newer one. A provider settles the newest version only, and none once another version
has become a contract.

An order is undecided while a transaction with it is on its way: a provider settles no other version then, and
honours no withdrawal. A transaction that failed when it was mined may succeed after all, if a reorganisation has it
mined again; so may one whose contract a reorganisation reverted. So the order stays undecided until the
transaction's nonce was used in a deep block, or until the node has lost the transaction. (Of another provider's
transaction only the block is known, and that it is mined again soon.)
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.base.flood import BoundedDict
from mesh.base.retry import Backoff, RetryPolicy
from mesh.market.book import BOOK, UNLIMITED, Look, Match, OrderBook, OrderRecord, OrderStage, order_id
from mesh.settings.groups import OPEN_ORDERS_LIMIT
from schemas import Result
from schemas.messages import lasting_hash
from schemas.signing import Refusal

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from mesh.market.book import Added, Order
    from schemas import Verified

    _Key = tuple[str, str]

UNFUNDED_RETRY: Final = RetryPolicy(initial=0.5, ceiling=60.0)
"""When an order's maker is asked after again: soon, as an approval may be under way."""


class OrderLimits(NamedTuple):
    """How many records of orders and results a provider keeps, at most."""

    open: int = OPEN_ORDERS_LIMIT
    """Orders in the book."""
    deadline: int = UNLIMITED
    """Blocks from now to the deadline of an order."""
    unfunded: int = 4096
    """Orders that wait for their makers' funds."""
    held: int = 16_384
    """Jurors' results that wait for others; each is signed by a juror of a liability's own validator."""
    used: int = 8192
    """Used messages, those of the blocks that a reorganisation may replace."""
    remembered: int = 32_768
    """Versions of orders, and orders that are bound to another one."""


ORDER_LIMITS: Final = OrderLimits()


class Orders:
    """The records of the orders and results in the market of a lighthouse (EIP-55 address).

    Those of orders are in its `book` first. Used ones are kept until their event is `depth` blocks deep. `withdrawn`
    has the identities of withdrawn orders. Times are of the event loop's clock, in seconds.
    """

    def __init__(
        self,
        lighthouse: str,
        *,
        depth: int,
        withdrawn: Container[bytes] = (),
        limits: OrderLimits = ORDER_LIMITS,
        retry: RetryPolicy = UNFUNDED_RETRY,
    ) -> None:
        self._records: dict[bytes, OrderRecord] = {}
        self.book: Final = OrderBook(
            lighthouse, limit=limits.open, deadline_limit=limits.deadline, records=self._records
        )
        self.versions: Final = OrderVersions(depth, remembered=limits.remembered)
        self._depth = depth
        self._withdrawn = withdrawn
        self._limits = limits
        self._retry = retry
        self._looks: list[tuple[float, bytes]] = []
        """A heap of when makers of unfunded orders are asked after; those that are outdated are skipped."""
        self._at: dict[str, dict[bytes, OrderRecord]] = {}
        """By liability: the messages that were used there, and the results for it, in order of arrival."""
        self._held: dict[bytes, OrderRecord] = {}
        """The results that wait for others, in order of arrival."""
        self._used: list[tuple[int, bytes]] = []
        """A heap of block and message of each event that was read, and for whose transaction nobody waits any more."""
        self._pairs: BoundedDict[bytes, bytes] = BoundedDict(limits.remembered)
        """Of each order of a pair (identity), the other one."""

    def state(self, identity: bytes) -> OrderStage | None:
        """Where the message with this identity is; None if there is no record of it."""
        record = self._records.get(identity)
        return None if record is None else record.state

    def settling(self, identity: bytes) -> Verified[Any] | None:
        """The message with this identity if it is under settlement: neither in the book nor forgotten."""
        record = self._records.get(identity)
        return None if record is None or record.state in BOOK else record.verified

    def add(self, order: Verified[Order], *, head: int) -> Match | Added | Refusal:
        """Receive an order whose maker can pay, as far as is known: match it, put it into the book, or refuse it.

        Older versions of it leave the book, and so does an unfunded copy.
        """
        self._note(order)
        identity = order_id(order)
        if self.state(identity) not in (None, OrderStage.UNFUNDED):
            return Refusal.DUPLICATE
        if (refusal := self.taken_back(order, head)) is not None:
            return refusal
        self.book.remove(identity, OrderStage.RECEIVED)
        outcome = self.book.add(order)
        if isinstance(outcome, Match):
            self.begin(*outcome)
        return outcome

    def pair(self, pair: Match, *, head: int) -> Refusal | None:
        """Bind a demand and an offer to each other by the will of the demand's maker, and begin to settle them.

        From now on neither is matched with another order. Its maker may bind a demand to a later offer; an offer stays
        with its first demand, and with what its maker signs in its place. Returns why that can't be.
        """
        demand, offer = (order_id(order) for order in pair)
        bound = self._pairs.get(offer, demand)
        is_another = bound != demand and not self.versions.has_version(bound, pair.demand)
        if is_another or any(self.settling(one) for one in (demand, offer)):
            return Refusal.DUPLICATE
        for order in pair:
            self._note(order)
            if order.message.deadline <= self.book.head:
                return Refusal.EXPIRED
            if (refusal := self.taken_back(order, head)) is not None:
                return refusal
        for identity in (demand, offer):
            self.book.remove(identity, OrderStage.REPLACED)
        self._pairs.pop(self._pairs.get(demand, b""), None)
        self._pairs[demand], self._pairs[offer] = offer, demand
        self.begin(*pair)
        return None

    def is_pair(self, pair: Match) -> bool:
        """Whether this demand is bound to this offer."""
        return self._pairs.get(order_id(pair.demand)) == order_id(pair.offer)

    def is_paired(self, order: Verified[Order]) -> bool:
        """Whether an order is bound to another one, so that the book must not have it."""
        return order_id(order) in self._pairs

    def taken_back(self, order: Verified[Order], head: int) -> Refusal | None:
        """Whether an order was withdrawn, or another version of it stands in its way, at block `head`."""
        identity = order_id(order)
        return Refusal.WITHDRAWN if identity in self._withdrawn else self.versions.refusal(identity, head)

    def _note(self, order: Verified[Order]) -> None:
        if (replaced := self.versions.note(order)) is not None:
            self.book.remove(replaced, OrderStage.REPLACED)

    # Orders whose makers can't pay.

    def set_aside(self, order: Verified[Order], *, now: float, head: int) -> bool:
        """Keep an order whose maker can't pay in the book, unmatched; whether it is there, now or already."""
        self._note(order)
        is_welcome = self.taken_back(order, head) is None and self.book.unfunded < self._limits.unfunded
        if is_welcome and self.book.set_aside(order):
            backoff = Backoff(self._retry)
            self._look(self._records[order_id(order)], now + (backoff.next_delay() or 0.0), backoff)
        return self.state(order_id(order)) is OrderStage.UNFUNDED

    def to_look_at(self, now: float, limit: int) -> list[OrderRecord]:
        """Take the unfunded orders whose makers are to be asked after now, `limit` of them at most."""
        due: list[OrderRecord] = []
        while self._looks and self._looks[0][0] <= now and len(due) < limit:
            at, identity = heapq.heappop(self._looks)
            record = self._records.get(identity)
            if record is not None and record.state is OrderStage.UNFUNDED and record.look.at == at:
                due.append(record)
        return due

    def looked_at(self, record: OrderRecord, *, is_funded: bool, now: float) -> Verified[Order] | None:
        """An order's maker was asked after. Returns the order, which leaves the book, if it can pay now."""
        if record.state is not OrderStage.UNFUNDED:
            return None
        if is_funded:
            return self.book.remove(record.identity, OrderStage.RECEIVED)
        self._look(record, now + (record.look.backoff.next_delay() or 0.0), record.look.backoff)
        return None

    def _look(self, record: OrderRecord, at: float, backoff: Backoff) -> None:
        record.look = Look(at, backoff)
        heapq.heappush(self._looks, (at, record.identity))

    # Messages under settlement.

    def begin(self, *messages: Verified[Any]) -> None:
        """A transaction with these messages will be sent."""
        for message in messages:
            record = self._settling(message)
            record.move(OrderStage.MATCHED)
            self._held.pop(record.identity, None)
            if isinstance(message.message, Result):
                self._place(record, message.message.liability)

    def sending(self, *messages: Verified[Any]) -> list[SentOrder]:
        """A transaction with these messages is sent next. Returns what must be on disk before, of orders."""
        for message in messages:
            record = self._records[order_id(message)]
            if record.state is OrderStage.MATCHED:
                record.move(OrderStage.SENDING)
        return self.versions.sending([one for one in messages if not isinstance(one.message, Result)])

    def end(self, message: Verified[Any], state: OrderStage = OrderStage.RECEIVED) -> bool:
        """No transaction with the message waits any more. Unless it was used, it enters `state` and leaves.

        Returns whether it was used.
        """
        record = self._records[order_id(message)]
        if record.state in (OrderStage.MATCHED, OrderStage.SENDING):
            self._leave(record, state)
            return False
        if record.state is OrderStage.MINED:
            record.move(OrderStage.CONFIRMED)
            heapq.heappush(self._used, (record.block, record.identity))
        return True

    def hold(self, result: Verified[Result]) -> Verified[Result] | None:
        """The result waits for others that agree with it, unless it is settled already.

        Returns the oldest that waits, which leaves, if too many do.
        """
        record = self._settling(result)
        if record.state is not OrderStage.RECEIVED:
            return None
        self._place(record, result.message.liability)
        self._held[record.identity] = record
        if len(self._held) <= self._limits.held:
            return None
        oldest = next(iter(self._held.values()))
        self._leave(oldest, OrderStage.REFUSED)
        return oldest.verified

    def held(self, liability: str) -> list[Verified[Result]]:
        """The results that wait at a liability, in order of arrival; none once one is being sent there, or was used."""
        records = self._records_at(liability, (Result,))
        if any(record.state is not OrderStage.RECEIVED for record in records):
            return []
        return [record.verified for record in records]

    def release(self, result: Verified[Result]) -> None:
        """Stop holding a result."""
        self._leave(self._held[order_id(result)], OrderStage.REFUSED)

    def created(self, liability: str, block: int, identity: bytes) -> None:
        """The event of a new liability was read, which this order was used for. No version of it stays in the book."""
        if (newest := self.versions.use(identity, liability)) is not None:
            self.book.remove(newest, OrderStage.REPLACED)
        order = self.book.remove(identity, OrderStage.CONFIRMED) or self.settling(identity)
        if order is not None:
            record = self._settling(order)
            self._place(record, liability)
            self._use(record, block)

    def finalized(self, liability: str, block: int) -> None:
        """The event of a liability's end was read."""
        for record in self._records_at(liability, (Result,)):
            self._use(record, block)

    def reverted(self, liability: str, *kinds: type[Any]) -> list[Verified[Any]]:
        """An event of the liability was reverted: its messages of these kinds that must be settled again, and leave.

        Those with a transaction that waits stay: its sender notices.
        """
        again = []
        for record in self._records_at(liability, kinds):
            record.block = 0
            if record.state is OrderStage.MINED:
                record.move(OrderStage.SENDING)
            elif record.state in (OrderStage.CONFIRMED, OrderStage.RECEIVED):
                self._leave(record, OrderStage.RECEIVED)
                again.append(record.verified)
        return again

    def is_read(self, message: Verified[Any], *, until: int) -> bool:
        """Whether an event that used the message was read, in block `until` or before."""
        return 0 < self._records[order_id(message)].block <= until

    def confirm(self, head: int) -> None:
        """Forget the messages whose event is so deep below block `head` that it stays."""
        while self._used and (self._used[0][0] <= head - self._depth or len(self._used) > self._limits.used):
            block, identity = heapq.heappop(self._used)
            record = self._records.get(identity)
            if record is not None and record.block == block and record.state is OrderStage.CONFIRMED:
                self._forget(record)

    def _settling(self, message: Verified[Any]) -> OrderRecord:
        """The record of a message under settlement, which may be new."""
        record = self._records.get(order_id(message))
        if record is None:
            record = self._records[order_id(message)] = OrderRecord(message)
        return record

    def _use(self, record: OrderRecord, block: int) -> None:
        record.block = block
        self._held.pop(record.identity, None)
        if record.state in (OrderStage.MATCHED, OrderStage.SENDING):
            record.move(OrderStage.MINED)
        elif record.state is not OrderStage.MINED:
            if record.state is not OrderStage.CONFIRMED:
                record.move(OrderStage.CONFIRMED)
            heapq.heappush(self._used, (block, record.identity))

    def _place(self, record: OrderRecord, liability: str) -> None:
        """Note where a message is used; an empty `liability` means nowhere."""
        if (placed := self._at.get(record.liability)) is not None:
            placed.pop(record.identity, None)
            if not placed:
                del self._at[record.liability]
        record.liability = liability
        if liability:
            self._at.setdefault(liability, {})[record.identity] = record

    def _leave(self, record: OrderRecord, state: OrderStage) -> None:
        if record.state is not state:
            record.move(state)
        self._forget(record)

    def _forget(self, record: OrderRecord) -> None:
        self._place(record, "")
        self._held.pop(record.identity, None)
        del self._records[record.identity]

    def _records_at(self, liability: str, kinds: tuple[type[Any], ...]) -> list[OrderRecord]:
        return [record for record in self._at.get(liability, {}).values() if isinstance(record.message, kinds)]


class SentOrder(NamedTuple):
    """An order (`order_id`) of a transaction, with what its versions share (`lasting_hash`, signer, deadline)."""

    identity: bytes
    lasting: str
    signer: str
    deadline: int


class SettledOrders(NamedTuple):
    """Orders on disk that can't change any more: those that are forgotten, and those that became contracts."""

    forgotten: list[bytes]
    contracts: list[bytes]


class _Newest(NamedTuple):
    nonce: int
    identity: bytes


class _Undecided(NamedTuple):
    """A version with which a transaction may still succeed.

    `block` decides once it is deep: the transaction's, or a later one, at which its nonce was found used; None while it
    was not. `nonce` is the transaction's; None if it is not known, or another account's.
    """

    identity: bytes
    """Empty: several versions."""
    block: int | None
    nonce: int | None


@dataclass(slots=True)
class _Family:
    newest: _Newest | None = None
    sending: bytes = b""
    """The version with which a transaction is on its way."""
    used: bytes = b""
    """The version that has become a contract."""
    sent: tuple[bytes, int] = (b"", 0)
    """The version in this account's last transaction that was mined, and its nonce."""
    undecided: _Undecided | None = None


class OrderVersions:
    """The versions of the orders that a provider has seen; of the last `remembered` of them.

    In generation 3 there is one of each. A reorganisation replaces up to `depth` blocks.
    """

    def __init__(self, depth: int, *, remembered: int = ORDER_LIMITS.remembered) -> None:
        self._depth = depth
        self._keys: BoundedDict[bytes, _Key] = BoundedDict(remembered)
        """Of each version (identity) its lasting hash and signer."""
        self._noted: BoundedDict[_Key, _Family] = BoundedDict(remembered)
        """Those of which only the newest version is known: a stranger can sign any number."""
        self._kept: BoundedDict[_Key, _Family] = BoundedDict(remembered)
        """Those with a transaction."""
        self._undecided: BoundedDict[_Key, _Family] = BoundedDict(remembered)
        """Those of them that are undecided."""
        self._contracts: BoundedDict[str, tuple[_Key, ...]] = BoundedDict(remembered)
        """What each contract (address) is of."""
        self._ended: dict[bytes, int] = {}
        """The versions (identity) on disk with which no transaction is on its way, and the block at which it ended."""

    def restore(self, sent: Iterable[SentOrder], *, contracts: Iterable[SentOrder] = (), nonce: int, head: int) -> None:
        """Take over what an earlier process has left on disk: transactions with nonces up to `nonce`."""
        for one in contracts:
            key = self._keys[one.identity] = one.lasting, one.signer
            self._keep(key).used = one.identity
        for one in sent:
            key = self._keys[one.identity] = one.lasting, one.signer
            self._wait(key, one.identity, nonce, head)
            self._ended[one.identity] = head

    def note(self, order: Verified[Order]) -> bytes | None:
        """Remember an order. Returns the identity of the version that it replaces, if that was the newest."""
        if order.message.generation == 3:
            return None
        identity, nonce, key = order_id(order), int(order.message.nonce), self._key_of(order)
        family = self._find(key) or _Family()
        before = family.newest
        if before is not None and before.nonce >= nonce:
            return None
        family.newest = _Newest(nonce, identity)
        if key not in self._kept:
            self._noted[key] = family
        return None if before is None else before.identity

    def refusal(self, identity: bytes, head: int) -> Refusal | None:
        """Why a version of an order is not settled, at block `head`: for the sake of another one."""
        if (key := self._keys.get(identity)) is None or (family := self._find(key)) is None:
            return None
        newest, undecided = family.newest, family.undecided
        if (family.used or identity) != identity or (newest is not None and newest.identity != identity):
            return Refusal.REPLACED
        others = {family.sending or identity}
        if undecided is not None and self._is_open(undecided, head):
            others.add(undecided.identity)
        return None if others == {identity} else Refusal.UNDECIDED

    def has_version(self, identity: bytes, order: Verified[Order]) -> bool:
        """Whether an order is a version of the one with this identity, by the same maker."""
        return order.message.generation == 5 and self._keys.get(identity) == (lasting_hash(order.message), order.signer)

    def is_undecided(self, identity: bytes, head: int) -> bool:
        """Whether, at block `head`, a transaction with a version of this order may still succeed."""
        if (family := self._find(self._key(identity))) is None:
            return False
        undecided = family.undecided
        return bool(family.sending) or (undecided is not None and self._is_open(undecided, head))

    def use(self, identity: bytes, liability: str) -> bytes | None:
        """A version became the contract at an address. Returns the identity of the newest one, if that is another."""
        key = self._key(identity)
        family = self._keep(key)
        family.used = identity
        self._contracts[liability] = (*self._contracts.get(liability, ()), key)
        newest = family.newest
        return None if newest is None or newest.identity == identity else newest.identity

    def sending(self, orders: Iterable[Verified[Order]]) -> list[SentOrder]:
        """A transaction with these orders is on its way until `ended`. Returns what must be on disk before."""
        kept = []
        for order in orders:
            key, identity = self._key_of(order), order_id(order)
            self._keep(key).sending = identity
            kept.append(SentOrder(identity, *key, order.message.deadline))
        return kept

    def ended(self, orders: Iterable[Verified[Order]], head: int) -> None:
        """No transaction with these orders is on its way any more, at block `head`."""
        for order in orders:
            identity, family = order_id(order), self._find(self._key_of(order))
            if family is not None and family.sending == identity:  # not another version's
                family.sending = b""
                self._ended[identity] = head

    def expire(self, head: int) -> SettledOrders:
        """What of the versions on disk can't change any more at block `head`; it is forgotten here."""
        deep = [identity for identity, block in self._ended.items() if block + self._depth <= head]
        done = SettledOrders([], [])
        for identity in deep:
            if not self.is_undecided(identity, head):
                del self._ended[identity]
                key = self._key(identity)
                family = self._find(key)
                # In generation 3 there are no other versions, and no signer in the key.
                is_contract = key[1] and family is not None and family.used == identity
                (done.contracts if is_contract else done.forgotten).append(identity)
        return done

    def sent(self, orders: Iterable[Verified[Order]], nonce: int) -> None:
        """The account's transaction with this nonce had these orders, and was mined."""
        for order in orders:
            self._keep(self._key_of(order)).sent = order_id(order), nonce

    def failed(self, orders: Iterable[Verified[Order]], nonce: int, block: int) -> None:
        """The account's transaction with these orders and this nonce failed, in a block or before it."""
        for order in orders:
            self._suspect(self._key_of(order), order_id(order), block, nonce)

    def vanished(self, orders: Iterable[Verified[Order]], nonce: int | None, head: int) -> None:
        """The account's transaction with these orders is not mined at block `head`, and may be later.

        `nonce` is its nonce, None if it is not known.
        """
        for order in orders:
            self._wait(self._key_of(order), order_id(order), nonce, head)

    def need_count(self) -> bool:
        """Whether `counted` must be called at the next block."""
        return any(family.undecided and family.undecided.nonce is not None for family in self._undecided.values())

    def counted(self, mined: int, pending: int | None, head: int) -> None:
        """The account has `mined` transactions up to block `head`, and `pending` with those that wait in a row.

        What may still be mined is decided later than this block. If none waits, a transaction whose nonce is the next
        one is lost: the node does not have it, and the account's next transaction takes its nonce. (`pending` is None
        if that is not certain.)
        """
        for key, family in list(self._undecided.items()):
            one = family.undecided
            assert one is not None
            is_lost = mined == pending == one.nonce
            if one.block is not None and one.block > head:  # a receipt was read before the block
                continue
            if one.nonce is not None and one.nonce >= mined and not is_lost:
                family.undecided = one._replace(block=None)
            elif one.block is None:  # mined in this block, or in one before that was not looked at
                family.undecided = one._replace(block=head)
            elif not self._is_open(one, head):
                family.undecided = None
                del self._undecided[key]

    def reorganised(self, last: int, head: int) -> None:
        """The blocks after `last`, up to `head`, were replaced: their transactions are mined again in later ones."""
        for family in self._undecided.values():
            if (one := family.undecided) is not None and one.block is not None and one.block > last:
                block = max(one.block, head + 1) if one.nonce is None else None
                family.undecided = one._replace(block=block)

    def free(self, liability: str, head: int) -> None:
        """A reorganisation of the blocks up to `head` reverted the contract at an address."""
        for key in self._contracts.pop(liability, ()):
            if (family := self._find(key)) is not None and family.used:
                identity, family.used = family.used, b""
                self._wait(key, identity, family.sent[1] if family.sent[0] == identity else None, head + 1)

    def _wait(self, key: _Key, identity: bytes, nonce: int | None, block: int) -> None:
        """A transaction with this version is not mined; if its `nonce` is not known, `block` decides."""
        self._suspect(key, identity, block if nonce is None else None, nonce)

    def _suspect(self, key: _Key, identity: bytes, block: int | None, nonce: int | None) -> None:
        """A transaction with this version of an order may still succeed; see `_Undecided`."""
        family = self._keep(key)
        before = family.undecided
        if before is not None and before.identity != identity and (block is None or self._is_open(before, block)):
            nonces = [one for one in (before.nonce, nonce) if one is not None]
            block = None if block is None or before.block is None else max(before.block, block)
            identity, nonce = b"", max(nonces, default=None)
        family.undecided = _Undecided(identity, block, nonce)
        self._undecided[key] = family

    def _is_open(self, undecided: _Undecided, head: int) -> bool:
        return undecided.block is None or undecided.block + self._depth > head

    def _find(self, key: _Key) -> _Family | None:
        return self._kept.get(key) or self._noted.get(key)

    def _keep(self, key: _Key) -> _Family:
        """The family of an order with a transaction, which may be new."""
        family = self._kept[key] = self._find(key) or _Family()
        self._noted.pop(key, None)
        return family

    def _key_of(self, order: Verified[Order]) -> _Key:
        identity = order_id(order)
        if order.message.generation == 5:
            key = self._keys.get(identity) or (lasting_hash(order.message), order.signer)
            self._keys[identity] = key
        return self._key(identity)

    def _key(self, identity: bytes) -> _Key:
        return self._keys.get(identity) or (identity.hex(), "")
