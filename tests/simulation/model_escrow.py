"""A model of how the factory takes and pays tokens (`Tokens.sol` and what the factory does with it)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tests.simulation.model_abi import ModelRevert, encode, functions, refused, word
from tests.simulation.model_contracts import NOBODY, ModelContract, ModelToken

if TYPE_CHECKING:
    from tests.simulation.model_orders import ModelTerms

ERC20: Final = {one.name: selector for selector, one in functions("XRT").items()}


class ModelEscrow(ModelContract):
    """What liabilities cost."""

    def xrt(self) -> bytes:
        """The token of fees and stakes."""
        return bytes(self.get("xrt"))

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
        if terms.cost:
            self._call_token(terms.token, ERC20["transfer"] + word(cost_to) + word(terms.cost))
        if terms.validator != NOBODY and terms.validator_fee:
            ModelToken(self.run, self.xrt(), self.address).transfer(fee_to, terms.validator_fee)

    def _take_exactly(self, token: bytes, owner: bytes, value: int) -> None:
        if not self.run.code(token):
            raise refused("TokenTransferFailed", token)
        before = self._balance(token)
        self._call_token(
            token, ERC20["transferFrom"] + encode(("address", "address", "uint256"), (owner, self.address, value))
        )
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
