"""`aira liability cancel`: ends a liability without a result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from mesh.cli.chain_client import notice_when_slow, open_signing_chain, units_of
from mesh.cli.errors import InvalidSignature, LiabilityEnded, NotAParty, NotRefundable, SignatureMissing
from mesh.cli.liability import OUTCOMES, liability_json, refund_words, state_of
from mesh.cli.options import ADDRESS, with_json, with_signing_settings
from mesh.cli.output import print_facts, print_json, print_line
from mesh.errors import InvalidMessage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import Chain, Settled
    from mesh.settings import Settings
    from schemas.records import Liability


@click.command("cancel")
@click.argument("address", type=ADDRESS)
@click.option("--signature", "signatures", multiple=True, help="a party's signature, as its own command printed it")
@click.option("--refund", is_flag=True, help="refund the promisee after the refund delay, without signatures")
@with_json
@with_signing_settings()
async def cancel(settings: Settings, address: str, signatures: tuple[str, ...], refund: bool, as_json: bool) -> None:
    """Cancel the liability at ADDRESS: the promisee gets the cost back, and the promisor is not paid.

    Both parties must agree. The first party runs this command without --signature: it prints a signature and sends
    nothing. The other party runs it with that --signature, which ends the liability. Anyone else can end it with both
    signatures.

    If the promisor has disappeared, --refund returns the cost once the refund delay has passed. Anyone may do this;
    `aira liability show` prints the block from which it is possible.
    """
    if refund and signatures:
        raise click.UsageError("--refund and --signature can't be used together")
    if refund:
        await _refund(settings, address, as_json)
    else:
        await _cancel(settings, address, signatures, as_json)


async def _refund(settings: Settings, address: str, as_json: bool) -> None:
    async with open_signing_chain(settings) as chain:
        liability = await _open_liability(chain, address)
        state = await chain.liabilities.refund_state(liability.address)
        if not state.is_refundable:
            raise NotRefundable(
                f"{liability.address} can't be refunded yet: {refund_words(state)}",
                hint="until then both parties can cancel it: `aira liability cancel` without --refund",
            )
        with notice_when_slow():
            settled = await chain.liabilities.refund(liability.address)
        await _print_end(chain, liability.address, settled, as_json)


async def _cancel(settings: Settings, address: str, signatures: Sequence[str], as_json: bool) -> None:
    async with open_signing_chain(settings) as chain:
        liability = await _open_liability(chain, address)
        signed = _signed(chain, liability, signatures)
        missing = [party for party in ("promisee", "promisor") if party not in signed]
        if not missing:
            with notice_when_slow():
                settled = await chain.liabilities.cancel(
                    liability.address, promisee_signature=signed["promisee"], promisor_signature=signed["promisor"]
                )
            await _print_end(chain, liability.address, settled, as_json)
        elif not signed:
            raise NotAParty(
                f"the account is neither promisee nor promisor of {liability.address}",
                hint="give the signatures of both parties, or the keyfile of one of them",
            )
        elif signatures:
            raise SignatureMissing(
                f"the signature of the {missing[0]} is missing",
                hint="the other party prints it with `aira liability cancel`",
            )
        else:
            _print_signature(chain, liability, signed, as_json)


async def _open_liability(chain: Chain, address: str) -> Liability:
    """The liability. Raises `LiabilityEnded` if it is finalized."""
    liability = await chain.liabilities.get(address)
    if liability.is_finalized:
        raise LiabilityEnded(f"{liability.address} has already ended: {OUTCOMES[state_of(liability)]}")
    return liability


def _signed(chain: Chain, liability: Liability, signatures: Sequence[str]) -> dict[str, str]:
    """Party → signature (0x…): the given signatures, and that of the own account if it is a party."""
    from schemas import cancellation_hash, recover

    assert chain.account is not None
    digest = cancellation_hash(liability.address)
    own = "0x" + chain.account.signer.sign_hash(digest).hex()
    parties = {"promisee": liability.promisee, "promisor": liability.promisor}
    signed = {party: own for party, address in parties.items() if address == chain.account.address}
    for signature in signatures:
        try:
            signer = recover(digest, signature)
        except InvalidMessage as error:
            raise InvalidSignature(
                f"invalid signature: {error.detail}", hint="a signature is 0x and 130 hexadecimal digits"
            ) from None
        found = {party: signature for party, address in parties.items() if address == signer}
        if not found:
            raise InvalidSignature(
                f"the signature is by {signer}, or for another liability",
                hint=f"the signer must be {liability.promisee} or {liability.promisor}",
            )
        signed |= found
    return signed


def _print_signature(chain: Chain, liability: Liability, signed: dict[str, str], as_json: bool) -> None:
    assert chain.account is not None
    party, signature = next(iter(signed.items()))
    other = "promisor" if party == "promisee" else "promisee"
    whose = getattr(liability, other)
    if as_json:
        facts = {"liability": liability.address, "signer": chain.account.address, "party": party}
        print_json(facts | {"signature": signature, "needed": whose})
        return
    print_line(f"as the {party}, you agree to cancel {liability.address} with this signature:\n\n{signature}\n")
    print_line(f"Nothing was sent. The {other}, {whose}, can end it with:\n")
    print_line(f"aira liability cancel {liability.address} --signature {signature}")


async def _print_end(chain: Chain, address: str, settled: Settled, as_json: bool) -> None:
    liability = await chain.liabilities.get(address)
    if as_json:
        print_json(liability_json(liability) | {"tx": settled.tx, "gasUsed": settled.gas_used})
        return
    unit = (await units_of(chain, [liability]))[liability.token]
    facts: dict[str, Any] = {
        "liability": liability.address,
        "state": OUTCOMES[state_of(liability)],
        "paid back": f"{unit.show(liability.cost)}  to {liability.promisee}",
        "transaction": settled.tx,
    }
    print_facts(facts)
