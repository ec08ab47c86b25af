"""Descriptions of tokens."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT, Token, TransactionSender
from tests.mesh.chain.conftest import no_contracts

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def test_the_token_of_the_network_is_described(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        token = await chain.tokens.info()
        assert (
            token == await chain.tokens.info("xrt.5.robonomics.eth") == await chain.tokens.info(market.deployment.xrt)
        )
    assert (token.address, token.symbol, token.name) == (market.deployment.xrt, "XRT", "Robonomics")
    assert 10**token.decimals == XRT
    assert token.total_supply >= 1_000_000 * XRT


async def test_an_address_without_a_token_is_an_error(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        with no_contracts("totalSupply"):
            await chain.tokens.info(market.stranger.address)


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
        token = await chain.tokens.info(address)
    assert (token.symbol, token.name) == ("MKR", "MKR")
    assert token.decimals == 0, "an answer that is not a number counts as no decimals"


async def test_a_token_without_a_description_has_no_symbol_and_no_decimals(market: DeployedMarket) -> None:
    """It has `totalSupply` alone: any other call is refused."""
    supply = bytes.fromhex("60003560e01c6318160ddd14601357600080fd5b600760005260206000f3")
    address = await _deployed(market, supply)
    async with market.chain() as chain:
        assert await chain.tokens.info(address) == Token(
            address=address, symbol="", name="", decimals=0, total_supply=7
        )


async def test_control_characters_in_a_tokens_name_are_removed(market: DeployedMarket) -> None:
    address = await _deployed(market, _answering(b"\x1b[31mXRT\n\xe2\x80\xae"))
    async with market.chain() as chain:
        assert (await chain.tokens.info(address)).symbol == "[31mXRT"
