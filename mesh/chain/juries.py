"""Juries: our validator contracts, whose jurors judge by a quorum (`contracts/src/Jury.sol`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.chain.artifacts import is_code_of
from mesh.chain.errors import Reverted
from mesh.chain.multicall import getters
from mesh.errors import ChainError, InputError
from schemas.address import ZERO_ADDRESS, address_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain.contracts import Contracts

MOST_JURORS: Final = 7
"""Jurors of a jury: a finalization looks through all sets of its quorum's size."""
JURY_GETTERS: Final = ("xrt", "keeper", "jurors", "quorum")


class InvalidJury(InputError, code="invalid-jury"):
    """These accounts and this quorum can't be a jury."""


class NotAJury(ChainError, code="not-a-jury"):
    """An address is not one of our juries, so its jurors and fees are not known."""

    def __init__(self, address: str) -> None:
        super().__init__(
            f"{address} is not a jury of this network", hint="name the address that `aira validator deploy` printed"
        )
        self.address = address


class NoFees(ChainError, code="no-fees"):
    """A jury holds no fees, so there is nothing to collect."""

    def __init__(self, address: str) -> None:
        super().__init__(
            f"the validator {address} has no fees to collect", hint="it is paid when its jurors have judged a result"
        )
        self.address = address


@dataclass(frozen=True, slots=True, kw_only=True)
class JuryState:
    """A validator contract of ours: results count that `quorum` of its `jurors` have signed. Addresses are EIP-55.

    The jurors are in ascending order. `keeper` may collect the `fees` (wn) that it holds. Only the fees change.
    """

    address: str
    keeper: str
    jurors: tuple[str, ...]
    quorum: int
    fees: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DeployedJury:
    """A jury that a transaction deployed, the gas that it used, and what that cost in wei."""

    address: str
    jurors: tuple[str, ...]
    quorum: int
    tx: str
    gas_used: int
    wei: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CollectedFees:
    """Fees (`value`, wn) that were paid out to a jury's keeper, the gas that it took, and what that cost in wei."""

    value: int
    tx: str
    gas_used: int
    wei: int


async def read_jury(contracts: Contracts, address: str) -> JuryState | None:
    """The jury at an address with code, without its fees; None if there is another contract. Raises `ChainError`."""
    node = contracts.node
    if not is_code_of("Jury", await node.code(address)):
        return None
    try:
        calls = getters("Jury", address, JURY_GETTERS)
        xrt, keeper, jurors, quorum = await node.read_all(calls, block="latest")
    except Reverted:
        return None
    # A contract with this code may have been created with jurors that our constructor refuses.
    is_sound = 1 <= quorum <= len(jurors) <= MOST_JURORS and xrt == contracts.xrt
    if not is_sound or list(jurors) != sorted(set(jurors), key=address_bytes):
        return None
    return JuryState(address=address, keeper=keeper, jurors=tuple(jurors), quorum=quorum, fees=0)


def in_order(jurors: Sequence[str], quorum: int) -> tuple[str, ...]:
    """Jurors (addresses) in the order in which the contract expects them. Raises `InvalidJury`."""
    if not 1 <= len(jurors) <= MOST_JURORS:
        raise InvalidJury(f"a jury has 1 to {MOST_JURORS} jurors, not {len(jurors)}", hint="name fewer jurors")
    ordered = tuple(sorted(set(jurors), key=address_bytes))
    if len(ordered) < len(jurors) or ZERO_ADDRESS in ordered:
        raise InvalidJury("a juror is named twice, or is the zero address", hint="name each juror once")
    if not 1 <= quorum <= len(ordered):
        raise InvalidJury(
            f"a quorum of {quorum} is not possible with {len(ordered)} jurors",
            hint=f"the quorum is 1 to {len(ordered)}, the number of jurors",
        )
    return ordered
