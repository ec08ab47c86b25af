"""Approvals by signature (EIP-2612), with which an account without ether can order: `chain.permits`."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import BoundedDict
from mesh.chain.errors import NoContracts, Reverted
from schemas import ZERO_ADDRESS, Permit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.base.clock import Clock
    from mesh.chain._contracts import Contracts
    from schemas import Demand, Verified

LIFETIME: Final = 7 * 86_400
"""Seconds for which a permit is valid that is signed here: longer than orders wait."""
KNOWN: Final = 8192
"""Permits of others that are remembered."""
PER_OWNER: Final = 8
"""Tokens of one owner for which permits are remembered."""
TOKEN_GAS: Final = 100_000
"""Gas for each question to a token."""
_WORD: Final = 32

PermitArguments = tuple[int, int, int, bytes, bytes]


def fee_for_carrying(demand: Demand) -> int:
    """What a demand pays, in its token's smallest unit, for carrying its permit; 0 if its fee is a validator's."""
    return demand.validator_fee if demand.validator == ZERO_ADDRESS else 0


def permit_arguments(permit: Permit) -> PermitArguments:
    """Value, deadline, v, r and s: what contracts take of a signed permit."""
    signature = bytes.fromhex(permit.signature)
    return permit.value, permit.deadline, signature[64], signature[:32], signature[32:64]


class Permits:
    """Signs the account's permits for the factory, and remembers the last one of each owner and token."""

    def __init__(self, contracts: Contracts, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._contracts, self._node, self._clock = contracts, contracts.node, clock
        self._known: BoundedDict[tuple[str, str], Permit] = BoundedDict(KNOWN)
        """By token and owner."""
        self._domains: BoundedDict[str, str] = BoundedDict(KNOWN)

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, permit: object) -> bool:
        return permit in self._known.values()

    def __iter__(self) -> Iterator[Permit]:
        """The permits that are remembered and not expired."""
        return iter([permit for permit in self._known.values() if not self._is_over(permit)])

    def note(self, permit: Permit) -> bool:
        """Remember a signed permit, whose signer is its owner; whether it is better than what was known.

        One is better that has a later nonce or, with the same, approves more or for longer. It must be for the factory.
        """
        is_taken = self._contracts.version.takes_permits and permit.spender == self._contracts.factory
        if not is_taken or self._is_over(permit):
            return False
        key = permit.token, permit.owner
        known = self._known.get(key)
        if known is not None and _rank(known) >= _rank(permit):
            return False
        if known is None and Counter(owner for _, owner in self._known)[permit.owner] >= PER_OWNER:
            return False
        self._known[key] = permit
        return True

    def of(self, token: str, owner: str) -> Permit | None:
        """The last known permit of an owner for a token, unless it is expired. The token may have taken it already."""
        permit = self._known.get((token, owner))
        return None if permit is None or self._is_over(permit) else permit

    async def sign(self, token: str, value: int) -> Permit | None:
        """A permit of the account, that the factory may take `value` of a token (address), and remember it.

        None if the token has no permits of EIP-2612, or refuses this one. Raises `NodeUnreachable`, `RequestRefused`.
        """
        contracts = self._contracts
        if not contracts.version.takes_permits:
            return None
        account = contracts.signing().account
        functions, owner = self._node.contract("XRT", token), account.address
        try:
            domain, nonce = await self._node.call_all(
                [(token, functions.DOMAIN_SEPARATOR().data), (token, functions.nonces(owner).data)],
                gas=TOKEN_GAS,
                most=_WORD,
            )
            if domain is None or nonce is None or len(domain) != _WORD or len(nonce) != _WORD:
                return None
            permit = account.signer.sign(
                Permit(
                    owner=owner,
                    spender=contracts.factory,
                    token=token,
                    value=value,
                    nonce=int.from_bytes(nonce),
                    deadline=int(self._clock.time()) + LIFETIME,
                    domain=domain.hex(),
                )
            )
            call = functions.permit(owner, contracts.factory, *permit_arguments(permit))
            await self._node.call({"to": token, "data": "0x" + call.data.hex()})
        except (Reverted, NoContracts):
            return None
        self._known[token, owner] = permit
        return permit

    async def needed_for(self, demand: Verified[Demand]) -> Permit | None:
        """The permit to create a demand's contract with; None if it needs none, or none is known that may help.

        Raises `NodeUnreachable`, `RequestRefused`.
        """
        order, owner = demand.message, demand.signer
        permit = self.of(order.token, owner)
        if permit is None:
            return None
        functions, fee = self._node.contract("XRT", order.token), fee_for_carrying(order)
        try:
            allowed, nonce = await self._node.read_all(
                (functions.allowance(owner, self._contracts.factory), functions.nonces(owner)), block="latest"
            )
        except (Reverted, NoContracts):
            return None
        if nonce == permit.nonce:
            return permit if fee or allowed < order.cost else None
        # Somebody has brought it to the token, so the allowance stands; it still says that its owner pays the fee.
        return permit if fee and nonce == permit.nonce + 1 else None

    def _is_over(self, permit: Permit) -> bool:
        return permit.deadline <= self._clock.time()


def _rank(permit: Permit) -> tuple[int, int, int]:
    return permit.nonce, permit.value, permit.deadline
