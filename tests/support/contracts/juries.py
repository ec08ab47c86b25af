"""Juries: validators of generation 5 whose jurors have keys, so that they can sign."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from schemas import Signer, address_bytes, keccak256
from tests.support.contracts.suite import Person, Suite, artifact

if TYPE_CHECKING:
    from collections.abc import Sequence

    from web3.contract import Contract


def ascending(*people: Person) -> list[Person]:
    """People in the order in which the contracts expect them."""
    return sorted(people, key=lambda person: address_bytes(person.address))


def some_people(count: int) -> list[Person]:
    """People without an account on the chain, who only sign; in ascending order."""
    signers = [Signer(keccak256(b"juror %d" % number)) for number in range(count)]
    return ascending(*(Person(signer.address, signer) for signer in signers))


class Panel:
    """A deployed jury: `quorum` of `jurors`, or of `size` new ones; the deployer is its keeper."""

    def __init__(self, suite: Suite, *jurors: Person, quorum: int = 1, size: int = 0) -> None:
        self.jurors: Final[Sequence[Person]] = ascending(*jurors) if jurors else some_people(size)
        addresses = [juror.address for juror in self.jurors]
        receipt = suite.send(_constructor(suite, addresses, quorum))
        assert receipt["contractAddress"] is not None
        self.gas = receipt["gasUsed"]
        self.address = str(receipt["contractAddress"])
        self.contract: Final[Contract] = suite.contract("Jury", self.address)

    @staticmethod
    def refusal(suite: Suite, jurors: Sequence[str], quorum: int) -> tuple[Any, ...]:
        """Why these can't be a jury."""
        return suite.chain.refusal(_Deployment(suite, jurors, quorum), suite.deployer.address)


class _Deployment:
    """A deployment that is tried without being sent, as `Chain.refusal` tries a call."""

    def __init__(self, suite: Suite, jurors: Sequence[str], quorum: int) -> None:
        self._web3 = suite.web3
        self._data = _constructor(suite, jurors, quorum).data_in_transaction

    def call(self, fields: Any, *, block_identifier: Any) -> None:
        fields |= {"data": self._data}
        self._web3.eth.call(fields, block_identifier)


def _constructor(suite: Suite, jurors: Sequence[str], quorum: int) -> Any:
    built = artifact("Jury")
    contract = suite.web3.eth.contract(abi=built["abi"], bytecode=built["bytecode"])
    return contract.constructor(suite.xrt.address, jurors, quorum)
