"""Validators: which ones orders may name, whose results they accept, and juries. `chain.validators`.

An offer on lighthouse L with validator V is, with the same signature, a demand on lighthouse V with validator L: the
format has the two addresses in swapped places. So a stranger whose demand names a lighthouse as validator could use the
offer of a robot that agrees to it as that robot's demand, and take the cost from the robot. V may belong to another
deployment, of which nobody here knows; keys and allowances are valid there, too. So nobody signs for an address because
it is no known lighthouse, but only for what can't be a lighthouse anywhere: a jury, by its code; an account that has
sent a transaction; and what its owner lists. The market's own lighthouses are always refused.
"""

from __future__ import annotations

import math
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.base.flood import BoundedDict
from mesh.chain._abi import is_code_of
from mesh.chain._contracts import OriginalContracts
from mesh.chain._lighthouses import Lighthouses
from mesh.chain._node import getters
from mesh.chain._tokens import Tokens
from mesh.chain.answers import InvalidAnswer
from mesh.chain.errors import InsufficientTokens, NoContracts, NotOffered, Reverted, UnknownName
from mesh.errors import ChainError, InputError
from schemas.address import ZERO_ADDRESS, address_bytes

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from mesh.chain._contracts import Contracts
    from schemas.messages import Order


MOST_JURORS: Final = 7
"""Jurors of a jury: a finalization looks through all sets of its quorum's size."""


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
        calls = getters("Jury", address, ("xrt", "keeper", "jurors", "quorum"))
        xrt, keeper, jurors, quorum = await node.read_all(calls, block="latest")
    except Reverted:
        return None
    # A contract with this code may have been created with jurors that our constructor refuses.
    is_sound = 1 <= quorum <= len(jurors) <= MOST_JURORS and xrt == contracts.xrt
    if not is_sound or list(jurors) != sorted(set(jurors), key=address_bytes):
        return None
    return JuryState(address=address, keeper=keeper, jurors=tuple(jurors), quorum=quorum, fees=0)


def in_order(jurors: Sequence[str], quorum: int) -> tuple[str, ...]:
    """Jurors (addresses) in the order in which the contract expects them. Raises `InputError` (`invalid-jury`)."""
    ordered = tuple(sorted(set(jurors), key=address_bytes))
    if not 1 <= len(jurors) <= MOST_JURORS:
        why, hint = f"a jury has 1 to {MOST_JURORS} jurors, not {len(jurors)}", "name fewer jurors"
    elif len(ordered) < len(jurors) or ZERO_ADDRESS in ordered:
        why, hint = "a juror is named twice, or is the zero address", "name each juror once"
    elif not 1 <= quorum <= len(ordered):
        why = f"a quorum of {quorum} is not possible with {len(ordered)} jurors"
        hint = f"the quorum is 1 to {len(ordered)}, the number of jurors"
    else:
        return ordered
    raise InputError(why, hint=hint, code="invalid-jury")


DELEGATION: Final = bytes.fromhex("ef0100")
"""How the code of an account begins that lets a contract's code run in its name (EIP-7702); no contract's does."""
REMEMBERED: Final = 4096
"""Validators whose verdict is remembered, the latest ones."""


class UnsafeValidator(InputError, code="validator-unsafe"):
    """An order names a validator that may be a lighthouse somewhere: it could be used as another order."""

    def __init__(self, validator: str) -> None:
        super().__init__(
            f"the validator {validator} is not known to be one: it may be a lighthouse, or become one",
            hint="name none, a jury of `aira validator deploy`, or an account that has sent a transaction; list another"
            " contract that you trust in the setting known_validators",
        )
        self.validator = validator


class _Verdict(NamedTuple):
    is_safe: bool
    may_be_settled: bool
    """Whether the market's own contracts can't be misled by it, though it may be a lighthouse elsewhere."""
    has_code: bool
    """Whether it is a contract; an account may delegate to one today and not tomorrow, so that doesn't count."""
    until: float = 0.0


class SettledValidators(NamedTuple):
    """Which validators a provider settles orders with: it signs none, so it refuses only its own market's lighthouses,
    and on the original contracts what could become one. What the parties trust is for them to say."""

    recall: Callable[[str], _Verdict | None]
    ask: Callable[[str], Awaitable[_Verdict]]

    def known(self, validator: str) -> bool | None:
        """Whether orders may name the validator; None if the chain has to be asked."""
        verdict = self.recall(validator)
        return None if verdict is None else verdict.may_be_settled

    async def is_safe(self, validator: str) -> bool:
        """The same, asked. Raises `ChainError`."""
        return validator == ZERO_ADDRESS or (await self.ask(validator)).may_be_settled


class _KnownJury(NamedTuple):
    state: JuryState | None
    until: float


class Validators:
    """What is known of validators. A jury or a lighthouse stays what it is, and is asked from the chain once.

    That an address is neither, or has no code, is asked again after a while: the node may have been behind, or answered
    wrongly.

    Somebody may be about to create a lighthouse at an address without code, unless it has a nonce: no contract is ever
    created there (EIP-684). `listed` (addresses or ENS names) are safe besides: their owner vouches for them.
    """

    def __init__(self, contracts: Contracts, *, listed: Sequence[str] = ()) -> None:
        self._contracts = contracts
        self._listed = listed
        self._verdicts: BoundedDict[str, _Verdict] = BoundedDict(REMEMBERED)
        self._juries: BoundedDict[str, _KnownJury] = BoundedDict(REMEMBERED)
        """Contracts that were asked whether they are juries; the fees are 0."""

    def known(self, validator: str) -> bool | None:
        """Whether orders may name the validator (EIP-55 address); None if the chain has to be asked."""
        if validator == ZERO_ADDRESS:
            return True
        verdict = self._known(validator)
        return None if verdict is None else verdict.is_safe

    async def is_safe(self, validator: str) -> bool:
        """Whether orders may name the validator. Raises `ChainError` if the chain can't be asked."""
        return validator == ZERO_ADDRESS or (await self._verdict(validator)).is_safe

    @property
    def settled(self) -> SettledValidators:
        """What a provider goes by instead."""
        return SettledValidators(self._known, self._verdict)

    async def check(self, order: Order) -> None:
        """Check before signing that the order may name its validator.

        Raises `UnsafeValidator`; `InputError` in generation 5, where it must be a contract; `NotOffered` for
        a jury that needs several signatures, on the original contracts; `ChainError`.
        """
        await self.check_named(order.validator, generation=order.generation)

    async def check_named(self, validator: str, *, generation: int) -> None:
        """Like `check`, for the validator (EIP-55 address) of an order that is still to be written."""
        if validator == ZERO_ADDRESS:
            return
        _check(validator, generation, await self._verdict(validator))
        version = self._contracts.version
        if isinstance(version, OriginalContracts) and await self.quorum(validator) > 1:
            raise NotOffered("validator that needs several signatures", version.generation)

    def check_known(self, order: Order) -> None:
        """Like `check`, by the last answer: a validator that was never asked about raises `UnsafeValidator`, too."""
        if order.validator != ZERO_ADDRESS:
            _check(order.validator, order.generation, self._verdicts.get(order.validator))

    async def quorum(self, validator: str) -> int:
        """How many accounts must sign the same result: a jury's quorum, 1 for other contracts.

        0 if there is no contract, as in generation 3: then the validator's own account finalizes. Raises `ChainError`.
        """
        if not (await self._verdict(validator)).has_code:
            return 0
        jury = await self._jury(validator)
        return 1 if jury is None else jury.quorum

    async def jurors(self, validator: str) -> tuple[str, ...] | None:
        """The jurors of a jury; None for another validator. Raises `ChainError`; a jury is asked once."""
        jury = await self._jury(validator) if (await self._verdict(validator)).has_code else None
        return None if jury is None else jury.jurors

    async def accepts(self, validator: str, signer: str) -> bool:
        """Whether `signer` is one who judges for the validator: a juror, or whom another contract accepts.

        An account judges for itself alone. Raises `ChainError` if the chain can't be asked. A jury is asked once, other
        contracts each time.
        """
        if validator == ZERO_ADDRESS:
            return False
        if not (await self._verdict(validator)).has_code:
            return signer == validator
        jurors = await self.jurors(validator)
        if jurors is not None:
            return signer in jurors
        try:
            call = self._contracts.node.contract("Jury", validator).isValidator(signer)
            return bool(await self._contracts.node.read(call))
        except (Reverted, NoContracts, InvalidAnswer):
            return False

    async def jury(self, validator: str) -> JuryState | None:
        """The jury at an address or ENS name; None if there is none of this network. Raises `ChainError`."""
        address = await self._contracts.names.address(validator)
        jury = await self._jury(address) if (await self._verdict(address)).has_code else None
        return None if jury is None else replace(jury, fees=await Tokens(self._contracts).balance(address))

    async def deploy(self, jurors: Sequence[str], quorum: int) -> DeployedJury:
        """Deploy a jury whose keeper is one's own account. `jurors` are 1 to 7 accounts (addresses or ENS names).

        Raises `InputError` (`invalid-jury`) before anything is sent.
        """
        ordered = in_order([await self._contracts.names.address(juror) for juror in jurors], quorum)
        code = self._contracts.node.creation_code("Jury", self._contracts.xrt, ordered, quorum)
        sent = await self._contracts.signing().send(to=None, data=code)
        assert sent.contract is not None
        return DeployedJury(
            address=sent.contract, jurors=ordered, quorum=quorum, tx=sent.tx, gas_used=sent.gas_used, wei=sent.wei
        )

    async def introduce(self) -> None:
        """Make one's own account known, so that orders may name it: send an empty transaction if it has sent none.

        Raises as other transactions do.
        """
        sender = self._contracts.signing()
        if not await self._contracts.node.transaction_count(sender.account.address):
            await sender.send(to=sender.account.address, data=b"")

    async def collect(self, validator: str, value: int | None = None) -> CollectedFees:
        """Pay fees (`value` wn, all by default) out of a jury to its keeper, one's own account.

        Raises `ChainError` (`not-a-jury`, `no-fees`), `InsufficientTokens`, `Reverted` (`NotTheKeeper`: another's).
        """
        jury = await self.jury(validator)
        if jury is None:
            raise ChainError(
                f"{validator} is not a jury of this network",
                hint="name the address that `aira validator deploy` printed",
                code="not-a-jury",
            )
        if not jury.fees and value is None:
            raise ChainError(
                f"the validator {jury.address} has no fees to collect",
                hint="it is paid when its jurors have judged a result",
                code="no-fees",
            )
        wanted = jury.fees if value is None else value
        if wanted > jury.fees:
            raise InsufficientTokens(jury.address, self._contracts.xrt, balance=jury.fees, needed=wanted)
        sent = await self._contracts.send(self._contracts.node.contract("Jury", jury.address).collect(wanted))
        return CollectedFees(value=wanted, tx=sent.tx, gas_used=sent.gas_used, wei=sent.wei)

    def _known(self, validator: str) -> _Verdict | None:
        verdict = self._verdicts.get(validator)
        return verdict if verdict is not None and time.monotonic() < verdict.until else None

    async def _verdict(self, validator: str) -> _Verdict:
        verdict = self._known(validator)
        if verdict is None:
            asked, is_final = await self._ask(validator)
            recheck = math.inf if is_final else self._contracts.node.timing.validator_recheck
            verdict = asked._replace(until=time.monotonic() + recheck)
            self._verdicts[validator] = verdict
        return verdict

    async def _ask(self, validator: str) -> tuple[_Verdict, bool]:
        """The verdict, and whether it is final."""
        if await Lighthouses(self._contracts).exists(validator):
            return _Verdict(is_safe=False, may_be_settled=False, has_code=True), True
        is_listed = await self._is_listed(validator)
        node = self._contracts.node
        code = await node.code(validator)
        if code and not code.startswith(DELEGATION):
            is_jury = await self._jury(validator) is not None
            return _Verdict(is_safe=is_jury or is_listed, may_be_settled=True, has_code=True), is_jury
        has_sent = await node.transaction_count(validator) > 0
        may_be_settled = has_sent or not isinstance(self._contracts.version, OriginalContracts)
        return _Verdict(is_safe=has_sent or is_listed, may_be_settled=may_be_settled, has_code=False), False

    async def _is_listed(self, validator: str) -> bool:
        for name in self._listed:
            with suppress(UnknownName):
                if await self._contracts.names.address(name) == validator:
                    return True
        return False

    async def _jury(self, contract: str) -> JuryState | None:
        """The jury at an address with code, without its fees; None if it is another contract."""
        known = self._juries.get(contract)
        if known is None or time.monotonic() >= known.until:
            state = await read_jury(self._contracts, contract)
            recheck = self._contracts.node.timing.validator_recheck if state is None else math.inf
            known = self._juries[contract] = _KnownJury(state, time.monotonic() + recheck)
        return known.state


def _check(validator: str, generation: int, verdict: _Verdict | None) -> None:
    if verdict is not None and generation == 5 and not verdict.has_code:
        raise InputError(
            f"there is no contract at the validator's address {validator}, so no result could ever be accepted",
            hint="in generation 5 name a contract (`aira validator deploy` makes one), or none",
            code="validator-without-code",
        )
    if verdict is None or not verdict.is_safe:
        raise UnsafeValidator(validator)
