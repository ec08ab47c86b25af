"""How validators say that they judge: asked from their jurors on the mesh, and checked on the chain."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from mesh.agent.handlers import Declined
from mesh.amounts import XRT
from mesh.base.flood import BoundedDict
from mesh.errors import RemoteError
from mesh.watching.market import signed_answers
from schemas import ZERO_ADDRESS, Demand
from schemas.keys import ValidatorKey
from schemas.signing import SignedRecord
from schemas.verdicts import PolicyNote, ValidatorAnnouncement

if TYPE_CHECKING:
    from collections.abc import Iterable

    import zenoh

    from mesh.chain import Chain
    from mesh.network import Channel

S = TypeVar("S", bound=SignedRecord)


class ValidatorSilent(RemoteError, code="validator-silent"):
    """No juror of the validator answers on the mesh, so its fee is not known, and perhaps nobody judges."""

    def __init__(self, validator: str) -> None:
        super().__init__(
            f"nobody answers as the validator {validator} on the mesh",
            hint="start it, or name another; with an explicit fee the demand is posted all the same",
        )
        self.validator = validator


@dataclass(frozen=True, slots=True, kw_only=True)
class AnnouncedValidator:
    """A validator as those of its jurors announce it that answered: `await agent.validator(address)`."""

    address: str
    """A contract, or in generation 3 an account that judges itself (EIP-55)."""
    announcements: tuple[ValidatorAnnouncement, ...]
    """One of each juror that answered; the validator accepts their signatures."""
    jurors: int
    """How many jurors the validator has."""
    quorum: int
    """How many of them must judge alike before the contract ends."""

    @property
    def is_silent(self) -> bool:
        """Whether no juror answered: perhaps nobody will judge."""
        return not self.announcements

    @property
    def has_quorum(self) -> bool:
        """Whether enough jurors answered to judge."""
        return len(self.announcements) >= self.quorum

    @property
    def title(self) -> str:
        """What the first juror calls the validator; empty if it is silent."""
        return self.announcements[0].title if self.announcements else ""

    @property
    def fee(self) -> int:
        """The fee at which enough jurors judge, in wn; if too few answered, the highest of theirs."""
        fees = sorted(int(one.fee) for one in self.announcements)
        return fees[min(self.quorum, len(fees)) - 1] if fees else 0

    @property
    def policies(self) -> tuple[PolicyNote, ...]:
        """What any juror judges by, each policy once."""
        return tuple(dict.fromkeys(policy for one in self.announcements for policy in one.policies))

    @property
    def is_unanimous(self) -> bool:
        """Whether all jurors that answered judge by the same policies."""
        return len({frozenset(one.policies) for one in self.announcements}) < 2

    def __repr__(self) -> str:
        policies = ", ".join(policy.name for policy in self.policies)
        online = f"{len(self.announcements)} of {self.jurors} jurors answer"
        return f"AnnouncedValidator({self.address}, {self.title!r}, {online}, fee={XRT.show(self.fee)}, {policies})"


class ValidatorDirectory:
    """Asks validators how they judge: `await directory.find(address)`. Answers are kept for a minute."""

    def __init__(self, session: zenoh.Session, channel: Channel, chain: Chain) -> None:
        self._session = session
        self._channel = channel
        self._chain = chain
        self._found: BoundedDict[str, tuple[AnnouncedValidator, float]] = BoundedDict(256)
        self._turns = asyncio.Semaphore(8)  # strangers' demands may name any number

    async def find(self, validator: str) -> AnnouncedValidator:
        """The validator (EIP-55 address) as its jurors announce it now. Raises `ChainError`."""
        async with self._turns:
            found, until = self._found.get(validator, (None, 0.0))
            if found is None or time.monotonic() >= until:
                found = await self._ask(validator)
                kept = 5.0 if found.is_silent else 60.0
                self._found[validator] = found, time.monotonic() + kept
            return found

    async def require_accepted(self, demand: Demand, accepted: str) -> None:
        """Raise `Declined` for a demand under whose validator an agent should not work.

        That is one that the setting (`accepted`) excludes, or one that wants a higher fee: it would refuse the work.
        """
        if demand.validator == ZERO_ADDRESS:
            return
        if accepted != "any":
            names = [] if accepted == "none" else [name.strip() for name in accepted.split(",")]
            if demand.validator not in [await self._chain.names.address(name) for name in names]:
                raise Declined("validator-not-accepted", f"it does not accept the validator {demand.validator}")
        wanted = (await self.find(demand.validator)).fee
        if demand.validator_fee < wanted:
            why = f"the demand pays {XRT.show(demand.validator_fee)} to its validator, which wants {XRT.show(wanted)}"
            raise Declined("validator-underpaid", why)

    async def _ask(self, validator: str) -> AnnouncedValidator:
        said = await signed_answers(
            self._session,
            [str(ValidatorKey(self._channel.lighthouse, validator))],
            ValidatorAnnouncement,
            lambda one: one.validator == validator,
            timeout=self._channel.answer_timeout,
            made_at=lambda one: one.made_at,
        )
        jurors = await accepted_of(self._chain, validator, said)
        announcements = tuple(said[juror] for juror in jurors)
        jury = await self._chain.validators.jury(validator)
        number = max((one.jurors for one in announcements), default=1) if jury is None else len(jury.jurors)
        quorum = 1 if jury is None else jury.quorum  # of another contract, or an account
        return AnnouncedValidator(address=validator, announcements=announcements, jurors=number, quorum=quorum)


async def accepted_of(chain: Chain, validator: str, signers: Iterable[str]) -> list[str]:
    """Those of the signers (addresses) whose judgement the validator accepts, sorted. Raises `ChainError`."""
    if (jury := await chain.validators.jury(validator)) is not None:
        return sorted(set(signers) & set(jury.jurors))
    some = sorted(signers, key=lambda signer: (signer != validator, signer))[:16]
    return [signer for signer in some if await chain.validators.accepts(validator, signer)]


async def check_named(chain: Chain, validator: str, *, lighthouse: str, generation: int) -> None:
    """Raise what signing a demand that names this validator would raise: `UnsafeValidator`, …"""
    from mesh.chain import UnsafeValidator  # an agent that watches does without the chain

    if validator == lighthouse:
        raise UnsafeValidator(validator)
    await chain.validators.check_named(validator, generation=generation)


async def refund_delay(chain: Chain) -> int | None:
    """The blocks after which a contract that was never finalized can be refunded; None if its contracts offer none."""
    if not await chain.has_mesh_contracts():
        return None
    return int(await chain.node.read(chain.node.contract("Factory", chain.factory).refundDelay()))
