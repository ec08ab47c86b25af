"""The versions of an order of generation 5: orders that differ in their nonce only.

When another order of an account has used a nonce, the account signs its open orders with that nonce again. A
reorganisation may free the nonce: then the older version would be valid again, and after it the newer one. A provider
settles the newest version only, and none once another version has become a contract.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec.structs import replace

from mesh.flood import BoundedDict
from mesh.market.book import order_id
from schemas import message_hash

if TYPE_CHECKING:
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


class OrderVersions:
    """The versions of the orders that a provider has seen; the last `limit` of them."""

    def __init__(self, *, limit: int = LIMIT) -> None:
        self._keys: BoundedDict[bytes, _Key] = BoundedDict(limit)
        """Of each version (identity) its lasting hash and signer."""
        self._newest: BoundedDict[_Key, _Newest] = BoundedDict(limit)
        self._used: BoundedDict[_Key, bytes] = BoundedDict(limit)
        """The version that has become a contract."""
        self._contracts: BoundedDict[str, tuple[_Key, ...]] = BoundedDict(limit)
        """What each contract (address) is of."""

    def note(self, order: Verified[Order]) -> bytes | None:
        """Remember an order. Returns the identity of the version that it replaces, if that was the newest."""
        if order.message.generation == 3:
            return None
        identity, nonce = order_id(order), int(order.message.nonce)
        key = self._keys.get(identity)
        if key is None:
            key = self._keys[identity] = lasting_hash(order.message), order.signer
        before = self._newest.get(key)
        if before is not None and before.nonce >= nonce:
            return None
        self._newest[key] = _Newest(nonce, identity)
        return None if before is None else before.identity

    def is_replaced(self, identity: bytes) -> bool:
        """Whether there is a newer version of an order, or another one has become a contract."""
        key = self._keys.get(identity)
        if key is None:
            return False
        newest = self._newest.get(key)
        return self._used.get(key, identity) != identity or (newest is not None and newest.identity != identity)

    def use(self, identity: bytes, liability: str) -> bytes | None:
        """A version became the contract at an address. Returns the identity of the newest one, if that is another."""
        key = self._keys.get(identity)
        if key is None:
            return None
        self._used[key] = identity
        self._contracts[liability] = (*self._contracts.get(liability, ()), key)
        newest = self._newest.get(key)
        return None if newest is None or newest.identity == identity else newest.identity

    def free(self, liability: str) -> None:
        """A reorganisation reverted the contract at an address."""
        for key in self._contracts.pop(liability, ()):
            self._used.pop(key, None)
