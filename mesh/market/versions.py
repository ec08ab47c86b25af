"""The versions of an order of generation 5: orders that differ in their nonce only.

When another order of an account has used a nonce, the account signs its open orders with that nonce again. A
reorganisation may free the nonce: then the older version would be valid again, and after it the newer one. A provider
settles the newest version only, and none once another version has become a contract.

A transaction that failed when it was mined costs its order nothing, but a reorganisation may have it mined again, with
success. Until its block is deep, a provider settles no other version of the order, and does not say that it is dead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec.structs import replace

from mesh.flood import BoundedDict
from mesh.market.book import order_id
from mesh.market.refusals import Refusal
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


class _FailedVersion(NamedTuple):
    identity: bytes
    block: int


class OrderVersions:
    """The versions of the orders that a provider has seen; the last `limit` of them.

    A reorganisation replaces blocks that are up to `reorg_depth` blocks behind the head.
    """

    def __init__(self, reorg_depth: int, *, limit: int = LIMIT) -> None:
        self._depth = reorg_depth
        self._keys: BoundedDict[bytes, _Key] = BoundedDict(limit)
        """Of each version (identity) its lasting hash and signer."""
        self._newest: BoundedDict[_Key, _Newest] = BoundedDict(limit)
        self._used: BoundedDict[_Key, bytes] = BoundedDict(limit)
        """The version that has become a contract."""
        self._contracts: BoundedDict[str, tuple[_Key, ...]] = BoundedDict(limit)
        """What each contract (address) is of."""
        self._failures: BoundedDict[_Key, _FailedVersion] = BoundedDict(limit)
        """Of which version the latest transaction failed that was mined, and in which block."""

    def note(self, order: Verified[Order]) -> bytes | None:
        """Remember an order. Returns the identity of the version that it replaces, if that was the newest."""
        if order.message.generation == 3:
            return None
        identity, nonce, key = order_id(order), int(order.message.nonce), self._key(order)
        before = self._newest.get(key)
        if before is not None and before.nonce >= nonce:
            return None
        self._newest[key] = _Newest(nonce, identity)
        return None if before is None else before.identity

    def refusal(self, identity: bytes, head: int) -> Refusal | None:
        """Why a version of an order is not settled, at block `head`: for the sake of another one."""
        key = self._keys.get(identity)
        if key is None:
            return None
        newest, failure = self._newest.get(key), self._failures.get(key)
        if self._used.get(key, identity) != identity or (newest is not None and newest.identity != identity):
            return Refusal.REPLACED
        is_other = failure is not None and failure.identity != identity
        return Refusal.UNDECIDED if is_other and self.is_undecided(identity, head) else None

    def is_undecided(self, identity: bytes, head: int) -> bool:
        """Whether, at block `head`, a failed transaction with a version of this order may still succeed."""
        failure = self._failures.get(self._keys.get(identity, ("", "")))
        return failure is not None and failure.block + self._depth > head

    def use(self, identity: bytes, liability: str) -> bytes | None:
        """A version became the contract at an address. Returns the identity of the newest one, if that is another."""
        key = self._keys.get(identity)
        if key is None:
            return None
        self._used[key] = identity
        self._contracts[liability] = (*self._contracts.get(liability, ()), key)
        newest = self._newest.get(key)
        return None if newest is None or newest.identity == identity else newest.identity

    def failed(self, orders: Iterable[Verified[Order]], block: int) -> None:
        """A transaction with these orders failed in a block; in none if it was not mined."""
        for order in orders if block else ():
            self._failures[self._key(order)] = _FailedVersion(order_id(order), block)

    def reorganised(self, last: int, head: int) -> None:
        """The blocks after `last`, up to `head`, were replaced: what failed in them is mined again in a later one."""
        for key, failure in self._failures.items():
            if failure.block > last:
                dict.__setitem__(self._failures, key, failure._replace(block=max(failure.block, head + 1)))

    def free(self, liability: str) -> None:
        """A reorganisation reverted the contract at an address."""
        for key in self._contracts.pop(liability, ()):
            self._used.pop(key, None)

    def _key(self, order: Verified[Order]) -> _Key:
        key = self._keys.get(identity := order_id(order))
        if key is None:
            key = self._keys[identity] = lasting_hash(order.message), order.signer
        return key
