"""Validators: which ones orders may name, whose results they accept, and juries. `chain.validators`.

A validator is no lighthouse, and nothing that could become one. An offer on lighthouse L with validator V is, with the
same signature, a demand on lighthouse V with validator L: the format has the two addresses in swapped places. So a
stranger whose demand names a lighthouse as validator could use the offer of a robot that agrees to it as that robot's
demand, and take the cost from the robot. Our contracts refuse such orders when the liability is created; the originals
don't.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.chain.answers import InvalidAnswer
from mesh.chain.contracts import OriginalContracts
from mesh.chain.errors import InsufficientTokens, NoContracts, NotOffered, Reverted
from mesh.chain.juries import CollectedFees, DeployedJury, NoFees, NotAJury, in_order, read_jury
from mesh.chain.lighthouses import Lighthouses
from mesh.chain.tokens import Tokens
from mesh.errors import InputError
from mesh.flood import BoundedDict
from schemas.address import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mesh.chain.contracts import Contracts
    from mesh.chain.juries import JuryState
    from schemas.messages import Order

REMEMBERED: Final = 4096
"""Validators whose verdict is remembered, the latest ones."""


class UnsafeValidator(InputError, code="validator-unsafe"):
    """An order names a validator that is a lighthouse, or could become one: it could be used as another order."""

    def __init__(self, validator: str) -> None:
        super().__init__(
            f"the validator {validator} is a lighthouse, or an account that is not known on the chain",
            hint="name another validator, or none; an account is known once it has sent a transaction",
        )
        self.validator = validator


class ValidatorWithoutCode(InputError, code="validator-without-code"):
    """A generation-5 order names a validator that is no contract, so no result could ever be accepted."""

    def __init__(self, validator: str) -> None:
        super().__init__(
            f"there is no contract at the validator's address {validator}",
            hint="in generation 5 name a contract (`aira validator deploy` makes one), or none",
        )
        self.validator = validator


class _Verdict(NamedTuple):
    is_safe: bool
    has_code: bool
    until: float


class _KnownJury(NamedTuple):
    state: JuryState | None
    until: float


class Validators:
    """What is known of validators, each asked from the chain once. A jury or a lighthouse stays what it is.

    That a contract is no jury is asked again after a while: the node may have been behind, or answered wrongly.

    With the originals, an address without code must have sent a transaction: else it may be that of a lighthouse which
    somebody is about to create.
    """

    def __init__(self, contracts: Contracts, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._contracts = contracts
        self._clock = clock
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

    async def check(self, order: Order) -> None:
        """Check before signing that the order may name its validator.

        Raises `UnsafeValidator`; `ValidatorWithoutCode` in generation 5, where it must be a contract; `NotOffered` for
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
        """Like `check`, without asking the chain: a validator that is not known raises `UnsafeValidator`, too."""
        if order.validator != ZERO_ADDRESS:
            _check(order.validator, order.generation, self._known(order.validator))

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

        Raises `InvalidJury` before anything is sent.
        """
        ordered = in_order([await self._contracts.names.address(juror) for juror in jurors], quorum)
        code = self._contracts.node.creation_code("Jury", self._contracts.xrt, ordered, quorum)
        sent = await self._contracts.signing().send(to=None, data=code)
        assert sent.contract is not None
        return DeployedJury(
            address=sent.contract, jurors=ordered, quorum=quorum, tx=sent.tx, gas_used=sent.gas_used, wei=sent.wei
        )

    async def collect(self, validator: str, value: int | None = None) -> CollectedFees:
        """Pay fees (`value` wn, all by default) out of a jury to its keeper, one's own account.

        Raises `NotAJury`, `NoFees`, `InsufficientTokens`; `Reverted` (`NotTheKeeper`) for another's jury.
        """
        jury = await self.jury(validator)
        if jury is None:
            raise NotAJury(validator)
        if not jury.fees and value is None:
            raise NoFees(jury.address)
        wanted = jury.fees if value is None else value
        if wanted > jury.fees:
            raise InsufficientTokens(jury.address, self._contracts.xrt, balance=jury.fees, needed=wanted)
        sent = await self._contracts.send(self._contracts.node.contract("Jury", jury.address).collect(wanted))
        return CollectedFees(value=wanted, tx=sent.tx, gas_used=sent.gas_used, wei=sent.wei)

    def _known(self, validator: str) -> _Verdict | None:
        verdict = self._verdicts.get(validator)
        return verdict if verdict is not None and self._clock() < verdict.until else None

    async def _verdict(self, validator: str) -> _Verdict:
        verdict = self._known(validator)
        if verdict is None:
            is_safe, has_code, is_final = await self._ask(validator)
            recheck = math.inf if is_final else self._contracts.node.timing.validator_recheck
            verdict = _Verdict(is_safe, has_code, self._clock() + recheck)
            self._verdicts[validator] = verdict
        return verdict

    async def _ask(self, validator: str) -> tuple[bool, bool, bool]:
        """Whether orders may name the validator, whether it is a contract, and whether that is final."""
        if await Lighthouses(self._contracts).exists(validator):
            return False, True, True
        node = self._contracts.node
        if await node.code(validator):
            return True, True, True
        if not isinstance(self._contracts.version, OriginalContracts):
            return True, False, False
        has_sent = await node.transaction_count(validator) > 0
        return has_sent, False, has_sent

    async def _jury(self, contract: str) -> JuryState | None:
        """The jury at an address with code, without its fees; None if it is another contract."""
        known = self._juries.get(contract)
        if known is None or self._clock() >= known.until:
            state = await read_jury(self._contracts, contract)
            recheck = self._contracts.node.timing.validator_recheck if state is None else math.inf
            known = self._juries[contract] = _KnownJury(state, self._clock() + recheck)
        return known.state


def _check(validator: str, generation: int, verdict: _Verdict | None) -> None:
    if verdict is None or not verdict.is_safe:
        raise UnsafeValidator(validator)
    if generation == 5 and not verdict.has_code:
        raise ValidatorWithoutCode(validator)
