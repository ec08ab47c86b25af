"""How tokens describe themselves, and amounts of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.amounts import InvalidAmount, Unit
from mesh.chain import XRT, TransactionSender
from mesh.errors import InputError
from schemas.address import shortened
from tests.mesh.chain.conftest import no_contracts

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def test_the_token_of_the_network_is_described(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        for named in (None, "xrt.5.robonomics.eth", market.deployment.xrt):
            unit = await chain.tokens.unit(named)
            assert (unit.symbol, 10**unit.decimals) == ("XRT", XRT)
            assert await chain.tokens.supply(named) >= 1_000_000 * XRT


async def test_an_address_without_a_token_is_an_error(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        with no_contracts("totalSupply"):
            await chain.tokens.supply(market.stranger.address)


async def _deployed(market: DeployedMarket, runtime: bytes) -> str:
    """A contract with that code."""
    init = bytes.fromhex("60") + bytes([len(runtime)]) + bytes.fromhex("80600b6000396000f3")
    async with market.chain(market.stranger) as chain:
        receipt = await TransactionSender(chain.node, market.stranger).send(to=None, data=init + runtime)
    assert receipt.contract is not None
    return receipt.contract


def _answering(word: bytes) -> bytes:
    """Code that answers everything with one word."""
    return b"\x7f" + word.ljust(32, b"\0") + bytes.fromhex("60005260206000f3")


async def test_a_symbol_of_32_bytes_is_decoded(market: DeployedMarket) -> None:
    address = await _deployed(market, _answering(b"MKR"))
    async with market.chain() as chain:
        unit = await chain.tokens.unit(address)
    assert unit.symbol == f"MKR ({shortened(address)})"
    assert unit.decimals == 0, "an answer that is not a number counts as no decimals"


async def test_a_token_without_a_description_has_no_symbol_and_no_decimals(market: DeployedMarket) -> None:
    """It has `totalSupply` alone: any other call is refused."""
    supply = bytes.fromhex("60003560e01c6318160ddd14601357600080fd5b600760005260206000f3")
    address = await _deployed(market, supply)
    async with market.chain() as chain:
        assert await chain.tokens.supply(address) == 7
        assert await chain.tokens.unit(address) == Unit(f"units ({shortened(address)})", 0)


async def test_control_characters_in_a_tokens_name_are_removed(market: DeployedMarket) -> None:
    address = await _deployed(market, _answering(b"\x1b[31mXRT\n\xe2\x80\xae"))
    async with market.chain() as chain:
        assert (await chain.tokens.unit(address)).symbol == f"[31mXRT ({shortened(address)})"


LIAR = "XRT\u202e\x00 USDC that is long"


def _calling_itself(symbol: str) -> bytes:
    """A token that answers each question with this symbol, as a string: longer ones are 32 bytes of it."""
    return _answering(symbol.encode()[:32])


async def test_a_token_that_takes_a_known_symbol_is_shown_with_its_address(market: DeployedMarket) -> None:
    liar = await _deployed(market, _calling_itself("XRT"))
    async with market.chain() as chain:
        own, other = await chain.tokens.unit(), await chain.tokens.unit(liar)
        assert (own.symbol, own.decimals, own.smallest) == ("XRT", 9, "wn")
        assert other.symbol == f"XRT ({shortened(liar)})"
        assert (await chain.tokens.amounts("5 xrt", default=liar)).token == chain.xrt


async def test_a_strangers_symbol_is_short_and_without_signs_that_change_the_text(market: DeployedMarket) -> None:
    liar = await _deployed(market, _calling_itself(LIAR))
    async with market.chain() as chain:
        symbol, _, address = (await chain.tokens.unit(liar)).symbol.rpartition(" ")
    assert address == f"({shortened(liar)})"
    assert symbol == "XRT USDC that is"
    assert symbol.isprintable()


async def test_an_amount_is_of_the_token_that_it_names(market: DeployedMarket) -> None:
    token = await _deployed(market, _calling_itself("GOLD"))
    async with market.chain() as chain:
        tokens = chain.tokens
        for given in (f"5 {token}", "5", "5 gold", "5units", 5):
            found = await tokens.amounts(given, default=token)
            assert (found.token, found.values) == (token, [5]), given
        assert (await tokens.amounts("100wn", default=token)).token == chain.xrt
        assert (await tokens.amounts(0, f"7 {token}")).token == token, "a number names none"
        assert tokens.price(15 * 10**8, chain.xrt, await tokens.unit()) == "1.5 XRT"
        assert tokens.price(7, token, await tokens.unit(token)) == f"7 {token}"


async def test_amounts_of_two_tokens_or_of_an_unknown_one_are_refused(market: DeployedMarket) -> None:
    token = await _deployed(market, _calling_itself("GOLD"))
    async with market.chain() as chain:
        with pytest.raises(InvalidAmount, match="two tokens"):
            await chain.tokens.amounts("5 XRT", token=token)
        with pytest.raises(InvalidAmount, match="two tokens"):
            await chain.tokens.amounts("5 XRT", f"5 {token}")
        with pytest.raises(InputError, match="'USDC' is no token") as caught:
            await chain.tokens.amounts("3.50 USDC", default=token)
        assert (caught.value.code, "XRT" in caught.value.hint) == ("unknown-token", True)


async def test_units_are_asked_once_in_one_request_and_what_is_no_token_has_its_smallest_unit(
    market: DeployedMarket,
) -> None:
    gold = await _deployed(market, _calling_itself("GOLD"))
    nothing = market.stranger.address
    async with market.chain() as chain:
        asked, call_all = list[int](), chain.node.call_all

        async def counted(calls: Any, **options: Any) -> Any:
            asked.append(len(calls))
            return await call_all(calls, **options)

        chain.node.call_all = counted  # type: ignore[method-assign]
        for _ in range(2):
            units = await chain.tokens.units([gold, chain.xrt, nothing])
            assert units[gold] == Unit(f"GOLD ({shortened(gold)})", 0)
            assert units[nothing] == Unit(f"units of {shortened(nothing)}", 0)
        assert asked == [9, 3], "only what is no token is asked again"
