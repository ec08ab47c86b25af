"""Ether, XRT and other ERC-20 tokens: balances, allowances, transfers. `chain.tokens`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.amounts import XRT, Unit
from mesh.chain.abi import decode
from mesh.chain.errors import NoContracts, Reverted
from mesh.errors import ChainError

if TYPE_CHECKING:
    from mesh.chain.abi import ContractCall, ContractFunctions
    from mesh.chain.contracts import Contracts

LONGEST_LABEL: Final = 64
"""Characters of a token's name or symbol that are shown; anybody can deploy a token with any name."""

MAX_DECIMALS: Final = 255


class NotAToken(ChainError, code="not-a-token"):
    """An address or name is not an ERC-20 token."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Token:
    """An ERC-20 token as it describes itself; only the address can be trusted.

    `symbol` and `name` are empty and `decimals` is 0 if it has none. `total_supply` is in its smallest unit, of
    which 10^`decimals` are one token.
    """

    address: str
    symbol: str
    name: str
    decimals: int
    total_supply: int


class Tokens:
    """Balances, allowances and transfers. The default token is XRT, the default account one's own."""

    def __init__(self, contracts: Contracts) -> None:
        self._contracts = contracts

    async def eth_balance(self, address: str | None = None) -> int:
        """Wei of an account; of one's own by default."""
        return await self._contracts.node.eth_balance(await self._contracts.address_or_own(address))

    async def send_eth(self, to: str, value: int) -> str:
        """Send `value` wei; the transaction's hash."""
        return (await self._contracts.signing().send(to=await self._address(to), data=b"", value=value)).tx

    async def info(self, token: str | None = None) -> Token:
        """A token's description (XRT by default). Raises `NoContracts` for an address without an ERC-20 token."""
        functions = await self._token(token)
        total_supply = int(await self._contracts.node.read(functions.totalSupply()))
        return Token(
            address=functions.address,
            symbol=_label(await self._ask(functions.symbol())),
            name=_label(await self._ask(functions.name())),
            decimals=_decimals(await self._ask(functions.decimals())),
            total_supply=total_supply,
        )

    async def unit(self, token: str | None = None) -> Unit:
        """The unit that a token is counted in (an address or ENS name; XRT by default). Raises `NotAToken`."""
        try:
            info = await self.info(token)
        except (NoContracts, Reverted):
            if token is None:
                raise
            raise NotAToken(f"{token} is not a token", hint="name an ERC-20 by its address or ENS name") from None
        if info.address == self._contracts.xrt:
            return Unit(info.symbol or XRT.symbol, info.decimals, XRT.smallest)
        return Unit(info.symbol or "tokens", info.decimals)

    async def balance(self, address: str | None = None, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that an account holds."""
        contract = await self._token(token)
        return int(await self._contracts.node.read(contract.balanceOf(await self._contracts.address_or_own(address))))

    async def allowance(self, owner: str, spender: str, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that `spender` may take from `owner`."""
        functions = await self._token(token)
        return int(
            await self._contracts.node.read(
                functions.allowance(await self._address(owner), await self._address(spender))
            )
        )

    async def balance_and_allowance(self, owner: str, spender: str, *, token: str | None = None) -> tuple[int, int]:
        """The same as `balance` and `allowance`, in one call."""
        functions, owner = await self._token(token), await self._address(owner)
        calls = (functions.balanceOf(owner), functions.allowance(owner, await self._address(spender)))
        balance, allowance = await self._contracts.node.read_all(calls, block="latest")
        return int(balance), int(allowance)

    async def approve(self, spender: str, value: int, *, token: str | None = None) -> str:
        """Let `spender` take up to `value` units of a token (XRT by default); the transaction's hash."""
        functions = await self._token(token)
        return (await self._contracts.send(functions.approve(await self._address(spender), value))).tx

    async def transfer(self, to: str, value: int, *, token: str | None = None) -> str:
        """Send units of a token (XRT by default); the transaction's hash."""
        functions = await self._token(token)
        return (await self._contracts.send(functions.transfer(await self._address(to), value))).tx

    async def transfer_from(self, owner: str, to: str, value: int, *, token: str | None = None) -> str:
        """Send what `owner` approved for this account; the transaction's hash."""
        functions = await self._token(token)
        return (
            await self._contracts.send(
                functions.transferFrom(await self._address(owner), await self._address(to), value)
            )
        ).tx

    async def _address(self, name_or_address: str) -> str:
        return await self._contracts.names.address(name_or_address)

    async def _token(self, token: str | None) -> ContractFunctions:
        address = self._contracts.xrt if token is None else await self._address(token)
        return self._contracts.node.contract("XRT", address)

    async def _ask(self, call: ContractCall) -> bytes:
        """The bytes that an optional function of a token returns; empty if the token lacks it."""
        request = {"to": call.address, "data": "0x" + call.data.hex()}
        try:
            return await self._contracts.node.call(request)
        except (Reverted, NoContracts):
            return b""


def _label(answer: bytes) -> str:
    """A printable text. Old tokens return 32 bytes instead of a string."""
    try:
        text = answer.rstrip(b"\0").decode() if len(answer) == 32 else decode(["string"], answer)[0]
    except ValueError:
        return ""
    return "".join(character for character in text if character.isprintable())[:LONGEST_LABEL].strip()


def _decimals(answer: bytes) -> int:
    value = int.from_bytes(answer, "big") if len(answer) == 32 else 0
    return value if value <= MAX_DECIMALS else 0
