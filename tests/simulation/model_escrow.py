# ruff: noqa: N802 - functions have the names of those in contracts/src, where they are described
"""A model of how the factory takes and pays tokens (`Tokens.sol`, `PullPayments.sol`, and what it does with them)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tests.simulation.model_abi import ModelRevert, checked, encode, functions, refused, word
from tests.simulation.model_contracts import NOBODY, ModelContract, ModelToken

if TYPE_CHECKING:
    from tests.simulation.model_orders import ModelTerms

ERC20: Final = {one.name: selector for selector, one in functions("XRT").items()}
PAY: Final = next(selector for selector, one in functions("Factory").items() if one.name == "pay")


class ModelEscrow(ModelContract):
    """What liabilities cost."""

    def xrt(self) -> bytes:
        """The token of fees and stakes."""
        return bytes(self.get("xrt"))

    def owed(self, token: bytes, account: bytes) -> int:
        return int(self.get("owed", token, account))

    def claim(self, token: bytes, account: bytes) -> None:
        self._claim(token, account, account)

    def claimTo(self, token: bytes, to: bytes) -> None:
        self._claim(token, self.sender, to)

    def pay(self, token: bytes, to: bytes, value: int) -> None:
        if self.sender != self.address:
            raise refused("NotTheFactory", self.sender)
        self._call_token(token, ERC20["transfer"] + word(to) + word(value))

    def _pay_or_owe(self, token: bytes, to: bytes, value: int) -> None:
        if not self.run.attempt(self.address, self.address, PAY + word(token) + word(to) + word(value)):
            self.set("owed", token, to, checked(self.owed(token, to) + value))
            self.log("PaymentRefused", token, to, value)

    def _claim(self, token: bytes, account: bytes, to: bytes) -> None:
        value = self.owed(token, account)
        if not value:
            raise refused("NothingOwed", token, account)
        self.set("owed", token, account, 0)
        self.log("Claimed", token, account, to, value)
        self._call_token(token, ERC20["transfer"] + word(to) + word(value))

    def _collect(self, terms: ModelTerms, provider: bytes) -> None:
        xrt = ModelToken(self.run, self.xrt(), self.address)
        if terms.lighthouse_fee:
            xrt.transferFrom(terms.promisor, provider, terms.lighthouse_fee)
        if terms.cost:
            if terms.token == self.xrt():
                xrt.transferFrom(terms.promisee, self.address, terms.cost)
            else:
                self._take_exactly(terms.token, terms.promisee, terms.cost)
        if terms.validator != NOBODY and terms.validator_fee:
            xrt.transferFrom(terms.promisee, self.address, terms.validator_fee)

    def _pay_out(self, terms: ModelTerms, cost_to: bytes, fee_to: bytes) -> None:
        xrt = ModelToken(self.run, self.xrt(), self.address)
        if terms.cost:
            if terms.token == self.xrt():
                xrt.transfer(cost_to, terms.cost)
            else:
                self._pay_or_owe(terms.token, cost_to, terms.cost)
        if terms.validator != NOBODY and terms.validator_fee:
            xrt.transfer(fee_to, terms.validator_fee)

    def _take(self, token: bytes, owner: bytes, to: bytes, value: int) -> None:
        call = encode(("address", "address", "uint256"), (owner, to, value))
        self._call_token(token, ERC20["transferFrom"] + call)

    def _take_exactly(self, token: bytes, owner: bytes, value: int) -> None:
        if not self.run.code(token):
            raise refused("TokenTransferFailed", token)
        before = self._balance(token)
        self._take(token, owner, self.address, value)
        received = max(0, self._balance(token) - before)
        if received != value:
            raise refused("TokenAmountMismatch", token, value, received)

    def _balance(self, token: bytes) -> int:
        answer = self.run.call(self.address, token, ERC20["balanceOf"] + word(self.address))
        if len(answer) < 32:
            raise ModelRevert
        return int.from_bytes(answer[:32], "big")

    def _call_token(self, token: bytes, data: bytes) -> None:
        try:
            answer = self.run.call(self.address, token, data)
        except ModelRevert as error:
            raise error if error.data else refused("TokenTransferFailed", token) from None
        silent = not answer and self.run.code(token)
        if not (silent or (len(answer) >= 32 and int.from_bytes(answer[:32], "big") == 1)):
            raise refused("TokenTransferFailed", token)
