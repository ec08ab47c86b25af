"""`aira liability cancel`: ends a liability without a result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from mesh.cli.chain_client import notice_when_slow, open_signing_chain, units_of
from mesh.cli.liability import OUTCOMES, facts_of, refund_words, state_of
from mesh.cli.options import with_json, with_signing_settings
from mesh.cli.output import print_facts, print_json, print_line
from mesh.errors import ChainError, InputError, InvalidMessage
from mesh.running import run_to_end

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain import Chain, Settled
    from mesh.settings import Settings
    from schemas.records import Liability


@click.command("cancel")
@click.argument("address")
@click.option(
    "--signature", "signatures", multiple=True, help="the other party's signature, as its own command printed it"
)
@click.option("--refund", is_flag=True, help="have the promisee paid back by the delay alone, without signatures")
@with_json
@with_signing_settings()
def cancel(settings: Settings, address: str, signatures: tuple[str, ...], refund: bool, as_json: bool) -> None:
    """Call off the work of the liability at ADDRESS: the promisee has its money back, nobody is paid.

    Both parties have to agree. The first runs this without --signature: nothing is sent, its signature is printed. It
    hands that to the other one, who runs this with --signature, which ends the liability. (Anybody else can send it
    with the signatures of both.)

    When the promisor has vanished, --refund has the promisee paid back once the contracts' delay has passed; anybody
    may do that. `aira liability show` says from when on.
    """
    if refund and signatures:
        raise click.UsageError("--refund needs no --signature")
    if refund:
        run_to_end(lambda: _refund(settings, address, as_json))
    else:
        run_to_end(lambda: _cancel(settings, address, signatures, as_json))


async def _refund(settings: Settings, address: str, as_json: bool) -> None:
    async with open_signing_chain(settings) as chain:
        liability = await _open_liability(chain, address)
        state = await chain.liabilities.refund_state(liability.address)
        if not state.is_refundable:
            raise ChainError(
                f"the money of {liability.address} can't be had back yet: {refund_words(state)}",
                hint="before that, both parties can call the work off: `aira liability cancel` without --refund",
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
            raise ChainError(
                f"the account is neither promisee nor promisor of {liability.address}",
                hint="give both parties' signatures, or the keyfile of one of them",
            )
        elif signatures:
            raise ChainError(f"the signature of the {missing[0]} is missing", hint="it is from the other party")
        else:
            _print_signature(chain, liability, signed, as_json)


async def _open_liability(chain: Chain, address: str) -> Liability:
    """The liability, which has not ended. Raises `ChainError`."""
    liability = await chain.liabilities.get(address)
    if liability.is_finalized:
        raise ChainError(f"{liability.address} has ended already: {OUTCOMES[state_of(liability)]}")
    return liability


def _signed(chain: Chain, liability: Liability, signatures: Sequence[str]) -> dict[str, str]:
    """The parties that agree, with their signatures (0x…): those given, and one's own if one is a party."""
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
            raise InputError(
                f"that is no signature: {error.detail}", hint="a signature is 0x and 130 hexadecimal digits"
            ) from None
        found = {party: signature for party, address in parties.items() if address == signer}
        if not found:
            raise InputError(
                f"the signature is of {signer}, or of another liability's cancellation",
                hint=f"needed are those of {liability.promisee} and {liability.promisor}",
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
    print_line(f"as the {party}, you agree to call off {liability.address} by this signature:\n\n{signature}\n")
    print_line(f"nothing was sent. The {other}, {whose}, ends it with\n")
    print_line(f"aira liability cancel {liability.address} --signature {signature}")


async def _print_end(chain: Chain, address: str, settled: Settled, as_json: bool) -> None:
    liability = await chain.liabilities.get(address)
    if as_json:
        print_json(facts_of(liability) | {"tx": settled.tx, "gasUsed": settled.gas_used})
        return
    unit = (await units_of(chain, [liability]))[liability.token]
    facts: dict[str, Any] = {
        "liability": liability.address,
        "state": OUTCOMES[state_of(liability)],
        "paid back": f"{unit.show(liability.cost)}  to {liability.promisee}",
        "transaction": settled.tx,
    }
    print_facts(facts)
