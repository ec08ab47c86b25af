# ruff: noqa: N802 - functions have the names of those in contracts/src, where they are described
"""A model of the factory (`Factory.sol`, `LighthouseNames.sol`, `Emission.sol`)."""

from __future__ import annotations

from typing import Final

from schemas import keccak256
from tests.simulation.model_abi import ModelRevert, artifact, checked, decode, refused, word
from tests.simulation.model_contracts import (
    NOBODY,
    ModelContract,
    ModelNames,
    ModelToken,
    permit_digest,
    recover_typed,
)
from tests.simulation.model_escrow import ERC20, ModelEscrow
from tests.simulation.model_liability import ModelLiability
from tests.simulation.model_lighthouse import ModelLighthouse
from tests.simulation.model_orders import (
    ModelOrder,
    ModelTerms,
    read_order,
    read_result,
    recover_signer,
    recover_signers,
    require_match,
    require_signer,
)

THIRD: Final = bytes.fromhex("87bd923a85f096b00a4a347fb56cef68e95319b3d9dae1dff59259db094afd02")
FIFTH: Final = bytes.fromhex("8d6c004b56cbe83bbfd9dcbd8f45d1f76398267bbb130a4629d822abc1994b96")
LETTERS: Final = frozenset(b"abcdefghijklmnopqrstuvwxyz0123456789-")


class ModelFactory(ModelEscrow):
    """The factory."""

    NAME = "Factory"

    def begin(self, ens: bytes = NOBODY, xrt: bytes = NOBODY, delay: int = 0, percent: int = 0) -> None:
        for name, value in (("ens", ens), ("xrt", xrt), ("delay", delay), ("percent", percent)):
            self.set(name, value)
        for number, name in ((1, "Liability"), (2, "Lighthouse")):
            made = keccak256(b"\xd6\x94" + self.address + bytes([number]))[12:]
            self.set(name, made)
            self.run.set(made, "contract", (_Implementation, bytes.fromhex(artifact(name)["deployedBytecode"][2:])))

    def ens(self) -> bytes:
        return bytes(self.get("ens"))

    def refundDelay(self) -> int:
        return int(self.get("delay"))

    def nonceOf(self, account: bytes) -> int:
        return int(self.get("nonce", account))

    def gasPrice(self) -> int:
        return 10 * 10**9

    def totalGasConsumed(self) -> int:
        return int(self.get("gas"))

    def totalGasUtilizing(self) -> int:
        return self.totalGasConsumed()

    def wnFor100Gas(self) -> int:
        return int(self.get("percent"))

    def wnFromGas(self, gas: int) -> int:
        return checked(gas * self.wnFor100Gas()) // 100

    def isLighthouse(self, account: bytes) -> bool:
        return bool(self.get("lighthouse", account))

    def isLiability(self, account: bytes) -> bool:
        return bool(self.get("liability", account))

    def isHashConsumed(self, digest: bytes) -> bool:
        return bool(self.get("first", digest, default=NOBODY) != NOBODY)

    def isOrderUsed(self, digest: bytes, signer: bytes) -> bool:
        if self.get("first", digest, default=NOBODY) == signer:
            return signer != NOBODY
        return bool(self.get("used", digest, signer))

    def gasConsumedOf(self, liability: bytes) -> int:
        if not self.isLiability(liability) or not ModelLiability(self.run, liability, self.address).isFinalized():
            return 0
        return _gas(self._terms(liability))

    def gasUtilizing(self, liability: bytes) -> int:
        return self.gasConsumedOf(liability)

    def createLighthouse(self, stake: int, timeout: int, name: bytes) -> bytes:
        if not 0 < stake < 1 << 128:
            raise refused("InvalidStake", stake)
        if not 0 < timeout < 1 << 32:
            raise refused("InvalidTimeout", timeout)
        if not _is_label(name):
            raise refused("InvalidName", name)
        names, label = ModelNames(self.run, self.ens(), self.address), keccak256(name)
        if names.owner(keccak256(FIFTH + label)) != NOBODY:
            raise refused("NameTaken", name)
        salt = keccak256(word(2) + word(self.run.chain_id))
        arguments = stake.to_bytes(16, "big") + timeout.to_bytes(4, "big") + name
        lighthouse = self._clone(ModelLighthouse, bytes(self.get("Lighthouse")), salt, arguments)
        self.set("lighthouse", lighthouse, True)
        made = {"factory": self.address, "xrt": self.xrt(), "minimal stake": stake, "timeout": timeout, "name": name}
        for variable, value in made.items():
            self.run.set(lighthouse, variable, value)
        resolver = names.resolver(FIFTH)
        for parent in (THIRD, FIFTH):
            names.setSubnodeRecord(parent, label, lighthouse, resolver, 0)
        self.log("NewLighthouse", lighthouse, name)
        return lighthouse

    def createLiability(self, demand: bytes, offer: bytes) -> None:
        self._make(self._agree(read_order(demand), read_order(offer)))

    def createLiabilityWithPermit(
        self, demand: bytes, offer: bytes, value: int, deadline: int, v: int, r: bytes, s: bytes
    ) -> None:
        terms = self._agree(read_order(demand), read_order(offer))
        owner, spender, signature = word(terms.promisee), word(self.address), word(v) + r + s
        permit = ERC20["permit"] + owner + spender + word(value) + word(deadline) + signature
        self.run.attempt(self.address, terms.token, permit)
        if terms.validator == NOBODY and terms.validator_fee:
            nonce = decode(["uint256"], self.run.call(self.address, terms.token, ERC20["nonces"] + owner))[0] - 1
            (domain,) = decode(["bytes32"], self.run.call(self.address, terms.token, ERC20["DOMAIN_SEPARATOR"]))
            digest = permit_digest(domain, terms.promisee, self.address, value, nonce % 2**256, deadline)
            if recover_typed(digest, v, r, s) != terms.promisee:
                raise refused("FeeNotPermitted", terms.promisee)
            self._take(terms.token, terms.promisee, self.data[-20:], terms.validator_fee)
        self._make(terms)

    def _make(self, terms: ModelTerms) -> None:
        self._collect(terms, self.data[-20:])
        liability = self._clone(ModelLiability, bytes(self.get("Liability")), word(1), terms.pack(self.xrt()))
        self.set("liability", liability, True)
        self.run.set(liability, "terms", terms)
        self.run.set(liability, "factory", self.address)
        self.log("NewLiability", liability)

    def withdrawOrder(self, digest: bytes) -> None:
        self._use_hash(digest, self.sender)
        self.log("OrderWithdrawn", digest, self.sender)

    def withdrawNonce(self, nonce: int) -> None:
        following = self.nonceOf(self.sender)
        if nonce != following:
            raise refused("WrongNonce", nonce, following)
        self.set("nonce", self.sender, nonce + 1)
        self.log("NonceWithdrawn", nonce, self.sender)

    def finalizeLiability(self, liability: bytes, result: bytes, success: bool, signature: bytes) -> None:
        terms = self._terms(liability)
        if self.sender != terms.lighthouse:
            raise refused("WrongLighthouse", terms.lighthouse, self.sender)
        self._finalize(liability, result, success, signature, self.data[-20:])

    def finalize(self, liability: bytes, result: bytes, success: bool, signature: bytes) -> None:
        self._finalize(liability, result, success, signature, NOBODY)

    def finalizeByValidator(
        self, validator: bytes, result: bytes, success: bool, signature: bytes, agree: bool
    ) -> None:
        terms = self._terms(self.sender)
        if terms.generation != 3 or terms.validator != validator:
            raise refused("NotTheValidator", validator)
        digest, signed = read_result(self.sender, result, success)
        require_signer(terms.promisor, recover_signer(signed, signature))
        self._end(self.sender, terms, digest, success and agree)
        self._credit(terms, success and agree, NOBODY)

    def refund(self, liability: bytes) -> None:
        terms = self._terms(liability)
        first = checked(terms.created_at + self.refundDelay())
        if self.run.block < first:
            raise refused("RefundTooEarly", first)
        self._give_back(liability, terms)

    def cancel(self, liability: bytes, by_promisee: bytes, by_promisor: bytes) -> None:
        terms, digest = self._terms(liability), keccak256(liability + b"cancel")
        require_signer(terms.promisee, recover_signer(digest, by_promisee))
        require_signer(terms.promisor, recover_signer(digest, by_promisor))
        self._give_back(liability, terms)

    def _terms(self, liability: bytes) -> ModelTerms:
        if not self.isLiability(liability):
            raise refused("NotALiability", liability)
        terms: ModelTerms = self.run.get(liability, "terms")
        return terms

    def _clone(self, kind: type[ModelContract], implementation: bytes, salt: bytes, arguments: bytes) -> bytes:
        proxy = bytes.fromhex("363d3d373d3d3d363d73") + implementation
        code = proxy + bytes.fromhex("5af43d82803e903d91602b57fd5bf3") + arguments
        creation = b"\x61" + len(code).to_bytes(2, "big") + bytes.fromhex("3d81600a3d39f3") + code
        made = keccak256(b"\xff" + self.address + salt + keccak256(creation))[12:]
        if self.run.code(made):
            raise ModelRevert(keccak256(b"CloneFailed()")[:4])
        self.run.set(made, "contract", (kind, code))
        return made

    def _agree(self, demand: ModelOrder, offer: ModelOrder) -> ModelTerms:
        if not self.isLighthouse(self.sender):
            raise refused("NotALighthouse", self.sender)
        require_match(demand, offer)
        lighthouse, validator, generation = demand.address(4), demand.address(5), 5 if demand.is_fifth else 3
        if lighthouse != self.sender:
            raise refused("WrongLighthouse", lighthouse, self.sender)
        if validator != NOBODY:
            if generation == 5 and not self.run.code(validator):
                raise refused("ValidatorWithoutCode", validator)
            if self.isLighthouse(validator):
                raise refused("ValidatorIsLighthouse", validator)
        promisee, signed_demand = self._use(demand)
        promisor, signed_offer = self._use(offer)
        return ModelTerms(
            generation,
            demand.digest(11),
            demand.digest(14),
            promisee,
            promisor,
            lighthouse,
            demand.address(2),
            validator,
            demand.words[3],
            offer.words[6],
            demand.words[6],
            self.run.block,
            signed_demand,
            signed_offer,
        )

    def _use(self, order: ModelOrder) -> tuple[bytes, tuple[bytes, int, int]]:
        deadline, nonce = order.words[7], 0
        if self.run.block >= deadline:
            raise refused("DeadlineReached", deadline)
        if order.is_fifth:
            sender = order.address(8)
            nonce = self.nonceOf(sender)
            self.set("nonce", sender, nonce + 1)
            digest = order.hash(nonce)
            signer = order.signer(digest)
            require_signer(sender, signer)
        else:
            digest = order.hash(0)
            signer = order.signer(digest)
            self._use_hash(digest, signer)
        self.log("HashConsumed", digest)
        return signer, (digest, deadline, nonce)

    def _use_hash(self, digest: bytes, signer: bytes) -> None:
        first = self.get("first", digest, default=NOBODY)
        if first == NOBODY:
            self.set("first", digest, signer)
            return
        if first == signer or self.get("used", digest, signer):
            raise refused("OrderUsed", digest)
        self.set("used", digest, signer, True)

    def _finalize(self, liability: bytes, result: bytes, success: bool, signature: bytes, provider: bytes) -> None:
        terms = self._terms(liability)
        digest, signed = read_result(liability, result, success)
        if terms.validator == NOBODY:
            require_signer(terms.promisor, recover_signer(signed, signature))
        elif terms.generation == 3:
            raise refused("NotTheValidator", self.sender if provider == NOBODY else provider)
        else:
            signer = recover_signers(signed, signature)
            ModelLiability(self.run, liability, self.address).ask_validator(terms.validator, signer)
        self._end(liability, terms, digest, success)
        self._credit(terms, success, provider)

    def _end(self, liability: bytes, terms: ModelTerms, digest: bytes, success: bool) -> None:
        ModelLiability(self.run, liability, self.address).settleByFactory(digest, success)
        self._pay_out(terms, terms.promisor if success else terms.promisee, terms.validator)

    def _give_back(self, liability: bytes, terms: ModelTerms) -> None:
        ModelLiability(self.run, liability, self.address).settleByFactory(bytes(32), False)
        self._pay_out(terms, terms.promisee, terms.promisee)
        self._credit(terms, False, NOBODY)

    def _credit(self, terms: ModelTerms, success: bool, provider: bytes) -> None:
        gas = _gas(terms)
        self.set("gas", self.totalGasConsumed() + gas)
        strangers = terms.promisee != terms.promisor and provider not in (terms.promisee, terms.promisor)
        if success and provider != NOBODY and terms.token == self.xrt() and terms.cost and strangers:
            ModelToken(self.run, self.xrt(), self.address).mint(provider, min(self.wnFromGas(gas), terms.cost))


class _Implementation(ModelContract):
    """What is behind clones; nobody calls it."""

    def answer(self) -> bytes:
        raise NotImplementedError("implementations are not modelled")


def _gas(terms: ModelTerms) -> int:
    gas = 268_000 if terms.generation == 3 else 224_000
    return gas + (51_000 if terms.cost else 0) + (19_500 if terms.lighthouse_fee else 0)


def _is_label(name: bytes) -> bool:
    is_hidden = name[:1] == b"-" or name[-1:] == b"-" or name[2:4] == b"--"
    return 0 < len(name) <= 32 and not is_hidden and LETTERS.issuperset(name)
