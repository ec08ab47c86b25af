# ruff: noqa: N802 - functions have the names of those in contracts/src, where they are described
"""A model of liabilities (`Liability.sol`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from tests.simulation.model_abi import ModelRevert, checked, functions, refused, word
from tests.simulation.model_contracts import ModelContract
from tests.simulation.model_orders import MULTIHASH

if TYPE_CHECKING:
    from tests.simulation.model_orders import ModelTerms

IS_VALIDATOR: Final = next(selector for selector, one in functions("Jury").items() if one.name == "isValidator")


class ModelLiability(ModelContract):
    """A liability."""

    NAME = "Liability"

    def _terms(self) -> ModelTerms:
        terms: ModelTerms = self.get("terms")
        return terms

    def factory(self) -> bytes:
        return bytes(self.get("factory"))

    def finalize(self, result: bytes, success: bool, signature: bytes, agree: bool) -> bool:
        factory: Any = self.run.contract(self.address, self.factory())
        factory.finalizeByValidator(self.sender, result, success, signature, agree)
        return True

    def settleByFactory(self, digest: bytes, success: bool) -> None:
        self._only_factory()
        if self.isFinalized():
            raise refused("AlreadyFinalized", self.address)
        self.set("end", (success, digest))
        self.log("Finalized", success, MULTIHASH + digest if any(digest) else b"")

    def askValidator(self, validator: bytes, signer: bytes) -> None:
        self._only_factory()
        self.ask_validator(validator, signer)

    def ask_validator(self, validator: bytes, signer: bytes) -> None:
        """What the factory asks it to do."""
        if not self.run.code(validator):
            raise ModelRevert
        answer = self.run.call(self.address, validator, IS_VALIDATOR + word(signer))
        if len(answer) < 32 or int.from_bytes(answer[:32], "big") > 1:
            raise ModelRevert
        if not any(answer[:32]):
            raise refused("RefusedByValidator", signer)

    def model(self) -> bytes:
        return MULTIHASH + self._terms().model

    def objective(self) -> bytes:
        return MULTIHASH + self._terms().objective

    def result(self) -> bytes:
        _, digest = self.get("end", default=(False, bytes(32)))
        return MULTIHASH + digest if any(digest) else b""

    def token(self) -> bytes:
        return self._terms().token

    def cost(self) -> int:
        return self._terms().cost

    def lighthouseFee(self) -> int:
        return self._terms().lighthouse_fee

    def validatorFee(self) -> int:
        return self._terms().validator_fee

    def demandHash(self) -> bytes:
        return self._terms().demand[0]

    def offerHash(self) -> bytes:
        return self._terms().offer[0]

    def promisee(self) -> bytes:
        return self._terms().promisee

    def promisor(self) -> bytes:
        return self._terms().promisor

    def lighthouse(self) -> bytes:
        return self._terms().lighthouse

    def validator(self) -> bytes:
        return self._terms().validator

    def generation(self) -> int:
        return self._terms().generation

    def createdAt(self) -> int:
        return self._terms().created_at

    def refundableFrom(self) -> int:
        factory: Any = self.run.contract(self.address, self.factory())
        return checked(self._terms().created_at + int(factory.refundDelay()))

    def isSuccess(self) -> bool:
        return bool(self.get("end", default=(False, b""))[0])

    def isFinalized(self) -> bool:
        return self.get("end", default=None) is not None

    def _only_factory(self) -> None:
        if self.sender != self.factory():
            raise refused("NotTheFactory", self.sender)
