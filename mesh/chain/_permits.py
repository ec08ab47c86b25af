"""Approvals by signature (EIP-2612), with which an account without ether can order: `chain.permits`."""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import BoundedDict
from mesh.chain._abi import WORD, decode
from mesh.chain.errors import NoContracts, Reverted
from schemas import ZERO_ADDRESS, Permit, address_bytes, keccak256

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.base.clock import Clock
    from mesh.chain._contracts import Contracts
    from schemas import Demand, Liability


class PermitLimits(NamedTuple):
    """How long permits are valid, and how many are remembered."""

    lifetime: int = 7 * 86_400
    """Seconds for which one is valid that is signed here: longer than orders wait."""
    owners: int = 2048
    """Accounts whose permits are remembered."""
    per_owner: int = 8
    """Permits of one of them."""


PERMIT_LIMITS: Final = PermitLimits()


class TokenLimits(NamedTuple):
    """What a token may use and say: anybody can deploy one with any code and any name."""

    gas: int = 100_000
    """For each question to it."""
    text: int = 5 * WORD
    """Bytes of its name, symbol or version as contracts return it, of which 96 are the text."""
    label: int = 64
    """Characters of such a text that are looked at."""
    symbol: int = 16
    """Those of its symbol that are shown."""
    decimals: int = 77
    """10^77 is the largest power of ten in a word."""
    asked: int = 64
    """Tokens that are asked for their units in one request."""


TOKEN_LIMITS: Final = TokenLimits()

_VERSION: Final = bytes.fromhex("54fd4d50")
_DOMAIN_TYPE: Final = keccak256(b"EIP712Domain(string name,string version,uint256 chainId,address verifyingContract)")

PermitArguments = tuple[int, int, int, bytes, bytes]


def permit_fee(order: Demand | Liability) -> int:
    """What a demand pays the provider, in its token's smallest unit, that creates its contract with its permit.

    0 if its fee is a validator's. Without a permit it is not charged.
    """
    return order.validator_fee if order.validator == ZERO_ADDRESS else 0


def permit_arguments(permit: Permit) -> PermitArguments:
    """Value, deadline, v, r and s: what contracts take of a signed permit."""
    signature = bytes.fromhex(permit.signature)
    return permit.value, permit.deadline, signature[64], signature[:32], signature[32:64]


class Permits:
    """Signs the account's permits for the factory, and remembers the best one of each owner, token and nonce.

    A permit is for the token whose domain it has: its signature covers that, and not the token that it names. Those of
    earlier nonces stay while there is room: a reorganisation may undo that the token has taken a later one.
    """

    def __init__(self, contracts: Contracts, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._contracts, self._node, self._clock = contracts, contracts.node, clock
        self._known: BoundedDict[str, dict[tuple[str, int], Permit]] = BoundedDict(PERMIT_LIMITS.owners)
        """By owner, then by domain and nonce."""
        self._signed: BoundedDict[str, Permit] = BoundedDict(PERMIT_LIMITS.owners)
        """The account's own, by token."""

    def __len__(self) -> int:
        return sum(map(len, self._known.values()))

    def __contains__(self, permit: object) -> bool:
        return permit in [*self]

    def __iter__(self) -> Iterator[Permit]:
        """The permits that are remembered and not expired."""
        known = [permit for permits in self._known.values() for permit in permits.values()]
        return iter([permit for permit in known if not self._is_over(permit)])

    def note(self, permit: Permit) -> bool:
        """Remember a signed permit, whose signer is its owner; whether it is better than what was known.

        With the same nonce, one is better if it approves more or for longer; any is better than an expired one. It must
        be for the factory. If an owner has too many, an expired one makes room, or one whose nonce is not the last.
        """
        is_taken = self._contracts.version.takes_permits and permit.spender == self._contracts.factory
        if not is_taken or self._is_over(permit):
            return False
        known = self._known.get(permit.owner, {}).get((permit.domain, permit.nonce))
        if known is not None and _rank(known) >= _rank(permit) and not self._is_over(known):
            return False
        return self._keep(permit)

    def _keep(self, permit: Permit) -> bool:
        """Remember a permit, perhaps instead of another one; whether there is room for it."""
        permits, key = self._known.get(permit.owner, {}).copy(), (permit.domain, permit.nonce)
        permits[key] = permit
        if len(permits) > PERMIT_LIMITS.per_owner:
            last = dict(sorted(permits))  # the last nonce of each domain
            spare = [one for one, known in permits.items() if self._is_over(known) or one[1] < last[one[0]]]
            dropped = min(spare, key=itemgetter(1), default=key)
            if dropped == key:
                return False
            del permits[dropped]
        self._known[permit.owner] = permits
        return True

    def has_any_of(self, owner: str) -> bool:
        """Whether a permit of this owner is known, for whatever token."""
        return owner in self._known

    def of(self, owner: str, domain: bytes, nonce: int) -> Permit | None:
        """The known permit of an owner with this nonce for the token with this domain, unless it is expired."""
        permit = self._known.get(owner, {}).get((domain.hex(), nonce))
        return None if permit is None or self._is_over(permit) else permit

    def own(self, token: str) -> Permit | None:
        """The account's last permit for a token (address), unless it is expired. The token may have taken it."""
        permit = self._signed.get(token)
        return None if permit is None or self._is_over(permit) else permit

    async def sign(self, token: str, value: int) -> Permit | None:
        """A permit of the account, that the factory may take `value` of a token (address), and remember it.

        None if the token has no permits of EIP-2612, or refuses this one; also if its domain is not made of its own
        name, version (`1` if it has none) and address: it could be that of a token which is worth more.

        Raises `NodeUnreachable`, `RequestRefused`.
        """
        contracts = self._contracts
        account = contracts.signing().account
        functions, owner = self._node.contract("XRT", token), account.address
        try:
            if (told := await self._told(token, owner)) is None:
                return None
            domain, nonce = told
            permit = account.signer.sign(
                Permit(
                    owner=owner,
                    spender=contracts.factory,
                    token=token,
                    value=value,
                    nonce=int.from_bytes(nonce),
                    deadline=int(self._clock.time()) + PERMIT_LIMITS.lifetime,
                    domain=domain.hex(),
                )
            )
            call = functions.permit(owner, contracts.factory, *permit_arguments(permit))
            await self._node.call({"to": token, "data": "0x" + call.data.hex()})
        except (Reverted, NoContracts):
            return None
        self._signed[token] = permit
        self._keep(permit)
        return permit

    async def are_taken(self, token: str) -> bool:
        """Whether `sign` may be able to sign for a token (address). Raises `NodeUnreachable`, `RequestRefused`."""
        try:
            return await self._told(token, ZERO_ADDRESS) is not None
        except (Reverted, NoContracts):
            return False

    async def _told(self, token: str, owner: str) -> tuple[bytes, bytes] | None:
        """A token's domain and the owner's nonce, a word each; None if the contracts or the token take no permits."""
        if not self._contracts.version.takes_permits:
            return None
        functions = self._node.contract("XRT", token)
        asked = functions.name().data, _VERSION, functions.DOMAIN_SEPARATOR().data, functions.nonces(owner).data
        calls = [(token, one) for one in asked]
        answers = await self._node.call_all(calls, gas=TOKEN_LIMITS.gas, most=TOKEN_LIMITS.text)
        name, version, domain, nonce = (answer or b"" for answer in answers)
        if len(nonce) != WORD or domain != _domain_of(name, version, self._node.chain_id, token):
            return None
        return domain, nonce

    def _is_over(self, permit: Permit) -> bool:
        return permit.deadline <= self._clock.time()


def _domain_of(name: bytes, version: bytes, chain_id: int, token: str) -> bytes | None:
    """The domain (EIP-712) of a token that answers with this name and version; None if it has no name."""
    try:
        (named,) = decode(["string"], name)
        (versioned,) = decode(["string"], version) if version else ("1",)
    except ValueError:
        return None
    texts = [keccak256(text.encode()) for text in (named, versioned)]
    words = chain_id.to_bytes(WORD, "big"), bytes(12) + address_bytes(token)
    return keccak256(b"".join((_DOMAIN_TYPE, *texts, *words)))


def _rank(permit: Permit) -> tuple[int, int]:
    return permit.value, permit.deadline
