"""The versions of an order of generation 5: orders that differ in their nonce only.

When another order of an account has used a nonce, the account signs its open orders with that nonce again. A
reorganisation may free the nonce: then the older version would be valid again, and after it the newer one. A provider
settles the newest version only, and none once another version has become a contract.

An order is undecided while a transaction with it is on its way: a provider settles no other version then, and
honours no withdrawal. A transaction that failed when it was mined may succeed after all, if a reorganisation has it
mined again; so may one whose contract a reorganisation reverted. So the order stays undecided until the
transaction's nonce was used in a deep block, or until the node has lost the transaction. (Of another provider's
transaction only the block is known, and that it is mined again soon.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec.structs import replace

from mesh.flood import BoundedDict
from mesh.market.book import order_id
from mesh.market.refusals import Refusal
from mesh.market.sent_orders import SentOrder, SentOrders
from schemas import message_hash

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.market.book import Order
    from schemas import Verified

    _Key = tuple[str, str]

LIMIT: Final = 32_768
"""Orders that are remembered, at most."""


class _Newest(NamedTuple):
    nonce: int
    identity: bytes


def lasting_hash(order: Order) -> str:
    """What all versions of an order share: in generation 5 its hash without the nonce, otherwise its hash."""
    return message_hash(order if order.generation == 3 else replace(order, nonce=0)).hex()


class _Undecided(NamedTuple):
    """A version with which a transaction may still succeed.

    `block` decides once it is deep: the transaction's, or a later one, at which its nonce was found used; None while it
    was not. `nonce` is the transaction's; None if it is not known, or another account's.
    """

    identity: bytes
    """Empty: several versions."""
    block: int | None
    nonce: int | None


class OrderVersions:
    """The versions of the orders that a provider has seen; the last `limit` of them.

    In generation 3 there is one of each. A reorganisation replaces up to `reorg_depth` blocks. `sent` keeps on disk
    what is undecided, or was a short time ago, and which versions became contracts.
    """

    def __init__(self, reorg_depth: int, sent: SentOrders | None = None, *, limit: int = LIMIT) -> None:
        self._depth = reorg_depth
        self._sent = sent or SentOrders()
        self._keys: BoundedDict[bytes, _Key] = BoundedDict(limit)
        """Of each version (identity) its lasting hash and signer."""
        self._newest: BoundedDict[_Key, _Newest] = BoundedDict(limit)
        self._used: BoundedDict[_Key, bytes] = BoundedDict(limit)
        """The version that has become a contract."""
        self._contracts: BoundedDict[str, tuple[_Key, ...]] = BoundedDict(limit)
        """What each contract (address) is of."""
        self._undecided: BoundedDict[_Key, _Undecided] = BoundedDict(limit)
        self._nonces: BoundedDict[bytes, int] = BoundedDict(limit)
        """Of this account's last transaction with each version (identity)."""
        self._sending: dict[_Key, bytes] = {}
        """The version with which a transaction is on its way."""
        self._ended: dict[bytes, int] = {}
        """The versions (identity) on disk of which none is, and the block at which it ended."""

    def restore(self, nonce: int, head: int) -> None:
        """Take over what an earlier process has left on disk: transactions with nonces up to `nonce`."""
        for one in self._sent.contracts:
            key = self._keys[one.identity] = one.lasting, one.signer
            self._used[key] = one.identity
        for one in self._sent.left:
            key = self._keys[one.identity] = one.lasting, one.signer
            self._wait(key, one.identity, nonce, head)
            self._ended[one.identity] = head

    def note(self, order: Verified[Order]) -> bytes | None:
        """Remember an order. Returns the identity of the version that it replaces, if that was the newest."""
        if order.message.generation == 3:
            return None
        identity, nonce, key = order_id(order), int(order.message.nonce), self._key_of(order)
        before = self._newest.get(key)
        if before is not None and before.nonce >= nonce:
            return None
        self._newest[key] = _Newest(nonce, identity)
        return None if before is None else before.identity

    def refusal(self, identity: bytes, head: int) -> Refusal | None:
        """Why a version of an order is not settled, at block `head`: for the sake of another one."""
        if (key := self._keys.get(identity)) is None:
            return None
        newest, undecided = self._newest.get(key), self._undecided.get(key)
        if self._used.get(key, identity) != identity or (newest is not None and newest.identity != identity):
            return Refusal.REPLACED
        others = {self._sending.get(key, identity)}
        if undecided is not None and self._is_open(undecided, head):
            others.add(undecided.identity)
        return None if others == {identity} else Refusal.UNDECIDED

    def is_undecided(self, identity: bytes, head: int) -> bool:
        """Whether, at block `head`, a transaction with a version of this order may still succeed."""
        undecided = self._undecided.get(key := self._key(identity))
        return key in self._sending or (undecided is not None and self._is_open(undecided, head))

    def use(self, identity: bytes, liability: str) -> bytes | None:
        """A version became the contract at an address. Returns the identity of the newest one, if that is another."""
        key = self._key(identity)
        self._used[key] = identity
        self._contracts[liability] = (*self._contracts.get(liability, ()), key)
        newest = self._newest.get(key)
        return None if newest is None or newest.identity == identity else newest.identity

    async def sending(self, orders: Iterable[Verified[Order]]) -> None:
        """A transaction with these orders will be sent, and is on its way until `ended`."""
        kept = []
        for order in orders:
            key, identity = self._key_of(order), order_id(order)
            self._sending[key] = identity
            kept.append(SentOrder(identity, *key, order.message.deadline))
        await self._sent.add(kept)

    def ended(self, orders: Iterable[Verified[Order]], head: int) -> None:
        """No transaction with these orders is on its way any more, at block `head`."""
        for order in orders:
            key, identity = self._key_of(order), order_id(order)
            if self._sending.get(key) == identity:  # not another version's
                del self._sending[key]
                self._ended[identity] = head

    async def expire(self, head: int) -> None:
        """Forget on disk what can't change any more at block `head`."""
        deep = [identity for identity, block in self._ended.items() if block + self._depth <= head]
        done = [identity for identity in deep if not self.is_undecided(identity, head)]
        for identity in done:
            del self._ended[identity]
        # In generation 3 there are no other versions, and no signer in the key.
        contracts = {one for one in done if (key := self._key(one))[1] and self._used.get(key) == one}
        await self._sent.remove(done, contracts=contracts, head=head)

    def sent(self, orders: Iterable[Verified[Order]], nonce: int) -> None:
        """The account's transaction with this nonce had these orders, and was mined."""
        self._nonces.update((order_id(order), nonce) for order in orders)

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
        return any(one.nonce is not None for one in self._undecided.values())

    def counted(self, mined: int, pending: int | None, head: int) -> None:
        """The account has `mined` transactions up to block `head`, and `pending` with those that wait in a row.

        What may still be mined is decided later than this block. If none waits, a transaction whose nonce is the next
        one is lost: the node does not have it, and the account's next transaction takes its nonce. (`pending` is None
        if that is not certain.)
        """
        for key, one in list(self._undecided.items()):
            is_lost = mined == pending == one.nonce
            if one.nonce is not None and one.nonce >= mined and not is_lost:
                self._undecided[key] = one._replace(block=None)
            elif one.block is None:  # mined in this block, or in one before that was not looked at
                self._undecided[key] = one._replace(block=head)
            elif not self._is_open(one, head):
                del self._undecided[key]

    def reorganised(self, last: int, head: int) -> None:
        """The blocks after `last`, up to `head`, were replaced: their transactions are mined again in later ones."""
        for key, undecided in list(self._undecided.items()):
            if undecided.block is not None and undecided.block > last:
                block = max(undecided.block, head + 1) if undecided.nonce is None else None
                self._undecided[key] = undecided._replace(block=block)

    def free(self, liability: str, head: int) -> None:
        """A reorganisation of the blocks up to `head` reverted the contract at an address."""
        for key in self._contracts.pop(liability, ()):
            if (identity := self._used.pop(key, None)) is not None:
                self._wait(key, identity, self._nonces.get(identity), head + 1)

    def _wait(self, key: _Key, identity: bytes, nonce: int | None, block: int) -> None:
        """A transaction with this version is not mined; if its `nonce` is not known, `block` decides."""
        self._suspect(key, identity, block if nonce is None else None, nonce)

    def _suspect(self, key: _Key, identity: bytes, block: int | None, nonce: int | None) -> None:
        """A transaction with this version of an order may still succeed; see `_Undecided`."""
        before = self._undecided.get(key)
        if before is not None and before.identity != identity and (block is None or self._is_open(before, block)):
            nonces = [one for one in (before.nonce, nonce) if one is not None]
            block = None if block is None or before.block is None else max(before.block, block)
            identity, nonce = b"", max(nonces, default=None)
        self._undecided[key] = _Undecided(identity, block, nonce)

    def _is_open(self, undecided: _Undecided, head: int) -> bool:
        return undecided.block is None or undecided.block + self._depth > head

    def _key_of(self, order: Verified[Order]) -> _Key:
        identity = order_id(order)
        if order.message.generation == 5:
            key = self._keys.get(identity) or (lasting_hash(order.message), order.signer)
            self._keys[identity] = key
        return self._key(identity)

    def _key(self, identity: bytes) -> _Key:
        return self._keys.get(identity) or (identity.hex(), "")
