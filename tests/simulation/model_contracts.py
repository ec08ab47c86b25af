# ruff: noqa: N802 - functions have the names of those in contracts/src, where they are described
"""A model of the token, the ENS registry, the resolver and the jury."""

from __future__ import annotations

from contextlib import suppress
from itertools import combinations
from typing import TYPE_CHECKING, Any, ClassVar

from schemas import InvalidMessage, address_bytes, keccak256
from schemas.signing import ORDER, recover_keys, signer_of
from tests.simulation.model_abi import ModelRevert, artifact, checked, decode, encode, functions, refused, word

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tests.simulation.model_state import ModelRun

NOBODY = bytes(20)
UNLIMITED = 2**256 - 1
MOST_XRT = 2**96 - 1
MOST_JURORS = 7
HALF_ORDER = ORDER // 2
PERMIT = keccak256(b"Permit(address owner,address spender,uint256 value,uint256 nonce,uint256 deadline)")
DOMAIN = keccak256(b"EIP712Domain(string name,string version,uint256 chainId,address verifyingContract)")


class ModelContract:
    """A contract that was called: its functions have the names of the ABI's. `get` and `set` are its storage."""

    NAME: ClassVar[str]
    """Of the artifact."""

    def __init__(self, run: ModelRun, address: bytes, sender: bytes, data: bytes = b"") -> None:
        self.run = run
        self.address = address
        self.sender = sender
        self.data = data

    def get(self, *cell: Any, default: Any = 0) -> Any:
        """A variable."""
        return self.run.get(self.address, *cell, default=default)

    def set(self, *cell_and_value: Any) -> None:
        """Change a variable."""
        self.run.set(self.address, *cell_and_value)

    def log(self, name: str, *values: Any) -> None:
        """Emit an event."""
        self.run.log(self.address, name, *values)

    def answer(self) -> bytes:
        """What the call returns."""
        function = functions(self.NAME).get(self.data[:4])
        if function is None:
            raise ModelRevert
        returned = getattr(self, function.name)(*decode(function.inputs, self.data[4:]))
        if not function.outputs:
            return b""
        return encode(function.outputs, returned if len(function.outputs) > 1 else (returned,))

    def construct(self, arguments: bytes) -> None:
        """What the constructor does."""
        types = [entry for entry in artifact(self.NAME)["abi"] if entry["type"] == "constructor"]
        self.begin(*decode([member["type"] for entry in types for member in entry["inputs"]], arguments))

    def begin(self) -> None:
        """The constructor."""


def recover_typed(digest: bytes, v: int, r: bytes, s: bytes) -> bytes:
    """Who signed a hash as EIP-712 has it."""
    if int.from_bytes(s, "big") <= HALF_ORDER and v in (27, 28):
        with suppress(InvalidMessage):
            return address_bytes(signer_of(recover_keys([(digest, r + s + bytes([v]), v - 27)])[0]))
    raise refused("InvalidSignature")


def permit_digest(domain: bytes, owner: bytes, spender: bytes, value: int, nonce: int, deadline: int) -> bytes:
    """What the owner of tokens signs (EIP-2612)."""
    fields = keccak256(PERMIT + b"".join(word(one) for one in (owner, spender, value, nonce, deadline)))
    return keccak256(b"\x19\x01" + domain + fields)


class ModelToken(ModelContract):
    """XRT. Its permits never expire: histories are shorter."""

    NAME = "XRT"

    def begin(self, supply: int = 0) -> None:
        self.set("deployer", self.sender)
        self._mint(self.sender, supply)

    def name(self) -> bytes:
        return b"Robonomics"

    def symbol(self) -> bytes:
        return b"XRT"

    def decimals(self) -> int:
        return 9

    def totalSupply(self) -> int:
        return int(self.get("supply"))

    def minter(self) -> bytes:
        return bytes(self.get("minter", default=NOBODY))

    def balanceOf(self, account: bytes) -> int:
        return int(self.get("balance", account))

    def allowance(self, owner: bytes, spender: bytes) -> int:
        return int(self.get("allowance", owner, spender))

    def nonces(self, owner: bytes) -> int:
        return int(self.get("permits", owner))

    def DOMAIN_SEPARATOR(self) -> bytes:
        names = keccak256(self.name()) + keccak256(b"1")
        return keccak256(DOMAIN + names + word(self.run.chain_id) + word(self.address))

    def permit(self, owner: bytes, spender: bytes, value: int, deadline: int, v: int, r: bytes, s: bytes) -> None:
        nonce = self.nonces(owner)
        signer = recover_typed(permit_digest(self.DOMAIN_SEPARATOR(), owner, spender, value, nonce, deadline), v, r, s)
        if signer != owner:
            raise refused("ERC2612InvalidSigner", signer, owner)
        self.set("permits", owner, nonce + 1)
        self.set("allowance", owner, spender, value)
        self.log("Approval", owner, spender, value)

    def setMinter(self, account: bytes) -> None:
        if self.sender != self.get("deployer"):
            raise refused("NotTheDeployer", self.sender)
        if self.minter() != NOBODY:
            raise refused("MinterAlreadySet")
        self.set("minter", account)

    def mint(self, account: bytes, value: int) -> bool:
        if self.sender != self.minter():
            raise refused("NotTheMinter", self.sender)
        self._mint(account, min(value, MOST_XRT - self.totalSupply()))
        return True

    def approve(self, spender: bytes, value: int) -> bool:
        self.set("allowance", self.sender, spender, value)
        self.log("Approval", self.sender, spender, value)
        return True

    def transfer(self, to: bytes, value: int) -> bool:
        self._transfer(self.sender, to, value)
        return True

    def transferFrom(self, owner: bytes, to: bytes, value: int) -> bool:
        allowed = self.allowance(owner, self.sender)
        if allowed < value:
            raise refused("ERC20InsufficientAllowance", self.sender, allowed, value)
        if allowed != UNLIMITED:
            self.set("allowance", owner, self.sender, allowed - value)
        self._transfer(owner, to, value)
        return True

    def _transfer(self, owner: bytes, to: bytes, value: int) -> None:
        if to == NOBODY:
            raise refused("ERC20InvalidReceiver", to)
        balance = self.balanceOf(owner)
        if balance < value:
            raise refused("ERC20InsufficientBalance", owner, balance, value)
        self.set("balance", owner, balance - value)
        self.set("balance", to, self.balanceOf(to) + value)
        self.log("Transfer", owner, to, value)

    def _mint(self, account: bytes, value: int) -> None:
        if account == NOBODY:
            raise refused("ERC20InvalidReceiver", account)
        supply = checked(self.totalSupply() + value)
        if supply > MOST_XRT:
            raise refused("SupplyTooLarge", supply)
        self.set("supply", supply)
        self.set("balance", account, self.balanceOf(account) + value)
        self.log("Transfer", NOBODY, account, value)


class ModelBlockingToken(ModelContract):
    """A token of the tests (`contracts/fixtures/Tokens.sol`) that refuses to pay accounts on its blocklist."""

    NAME = "BlockingToken"

    def begin(self, supply: int = 0) -> None:
        self.set("balance", self.sender, supply)
        self.set("supply", supply)

    def totalSupply(self) -> int:
        return int(self.get("supply"))

    def allowance(self, owner: bytes, spender: bytes) -> int:
        return UNLIMITED

    def balanceOf(self, account: bytes) -> int:
        return int(self.get("balance", account))

    def isBlocked(self, account: bytes) -> bool:
        return bool(self.get("blocked", account))

    def setBlocked(self, account: bytes, blocked: bool) -> None:
        self.set("blocked", account, blocked)

    def setRefusal(self, way: int) -> None:
        if way > 3:
            raise ModelRevert
        self.set("way", way)

    def transfer(self, to: bytes, value: int) -> bool:
        way = self.get("way")
        if self.isBlocked(to) and way != 1:
            raise ModelRevert({0: keccak256(b"Blocked(address)")[:4] + word(to), 3: bytes(200_000)}.get(way, b""))
        self._move(self.sender, to, value)
        return not self.isBlocked(to)

    def transferFrom(self, owner: bytes, to: bytes, value: int) -> bool:
        self._move(owner, to, value)
        return True

    def _move(self, owner: bytes, to: bytes, value: int) -> None:
        self.set("balance", owner, checked(self.balanceOf(owner) - value))
        self.set("balance", to, checked(self.balanceOf(to) + value))


class ModelNames(ModelContract):
    """The ENS registry. A record is owner, resolver and ttl."""

    NAME = "ENSRegistry"

    def begin(self) -> None:
        self.set("record", bytes(32), (self.sender, NOBODY, 0))

    def _record(self, node: bytes) -> tuple[bytes, bytes, int]:
        record: tuple[bytes, bytes, int] = self.get("record", node, default=(NOBODY, NOBODY, 0))
        return record

    def _own(self, node: bytes) -> tuple[bytes, bytes, int]:
        record = self._record(node)
        if record[0] != self.sender:
            raise refused("NotTheOwner", node, self.sender)
        return record

    def owner(self, node: bytes) -> bytes:
        return self._record(node)[0]

    def resolver(self, node: bytes) -> bytes:
        return self._record(node)[1]

    def ttl(self, node: bytes) -> int:
        return self._record(node)[2]

    def recordExists(self, node: bytes) -> bool:
        return self.owner(node) != NOBODY

    def setOwner(self, node: bytes, owner: bytes) -> None:
        _, resolver, ttl = self._own(node)
        self.set("record", node, (owner, resolver, ttl))
        self.log("Transfer", node, owner)

    def setResolver(self, node: bytes, resolver: bytes) -> None:
        owner, _, ttl = self._own(node)
        self.set("record", node, (owner, resolver, ttl))
        self.log("NewResolver", node, resolver)

    def setTTL(self, node: bytes, ttl: int) -> None:
        owner, resolver, _ = self._own(node)
        self.set("record", node, (owner, resolver, ttl))
        self.log("NewTTL", node, ttl)

    def setSubnodeOwner(self, node: bytes, label: bytes, owner: bytes) -> bytes:
        self._own(node)
        subnode = keccak256(node + label)
        _, resolver, ttl = self._record(subnode)
        self.set("record", subnode, (owner, resolver, ttl))
        self.log("NewOwner", node, label, owner)
        return subnode

    def setSubnodeRecord(self, node: bytes, label: bytes, owner: bytes, resolver: bytes, ttl: int) -> None:
        self._own(node)
        subnode = keccak256(node + label)
        self.set("record", subnode, (owner, resolver, ttl))
        self.log("NewOwner", node, label, owner)
        self.log("NewResolver", subnode, resolver)


class ModelResolver(ModelContract):
    """The resolver."""

    NAME = "Resolver"

    def begin(self, ens: bytes = NOBODY) -> None:
        self.set("ens", ens)

    def _owner(self, node: bytes) -> bytes:
        return ModelNames(self.run, self.get("ens"), self.address).owner(node)

    def _own(self, node: bytes) -> None:
        if self._owner(node) != self.sender:
            raise refused("NotTheOwner", node, self.sender)

    def addr(self, node: bytes) -> bytes:
        known: bytes = self.get("addr", node, default=NOBODY)
        if known != NOBODY:
            return known
        owner = self._owner(node)
        return owner if self.run.code(owner) else NOBODY

    def multihash(self, node: bytes) -> bytes:
        return bytes(self.get("multihash", node, default=b""))

    def setAddr(self, node: bytes, address: bytes) -> None:
        self._own(node)
        self.set("addr", node, address)
        self.log("AddrChanged", node, address)

    def setMultihash(self, node: bytes, content: bytes) -> None:
        self._own(node)
        self.set("multihash", node, content)
        self.log("MultihashChanged", node, content)

    def supportsInterface(self, interface: bytes) -> bool:
        known = {"supportsInterface", "addr", "multihash"}
        return any(interface == selector for selector, one in functions(self.NAME).items() if one.name in known)


class ModelJury(ModelContract):
    """A validator of generation 5."""

    NAME = "Jury"

    def begin(self, xrt: bytes = NOBODY, jurors: Sequence[bytes] = (), quorum: int = 0) -> None:
        if not 1 <= len(jurors) <= MOST_JURORS:
            raise refused("InvalidJurorCount", len(jurors), MOST_JURORS)
        if not 1 <= quorum <= len(jurors):
            raise refused("InvalidQuorum", quorum, len(jurors))
        for previous, juror in zip((NOBODY, *jurors), jurors, strict=False):
            if juror <= previous:
                raise refused("JurorsOutOfOrder", previous, juror)
        for name, value in (("keeper", self.sender), ("xrt", xrt), ("jurors", tuple(jurors)), ("quorum", quorum)):
            self.set(name, value)

    def MOST_JURORS(self) -> int:
        return MOST_JURORS

    def keeper(self) -> bytes:
        return bytes(self.get("keeper"))

    def xrt(self) -> bytes:
        return bytes(self.get("xrt"))

    def jurors(self) -> tuple[bytes, ...]:
        return tuple(self.get("jurors"))

    def quorum(self) -> int:
        return int(self.get("quorum"))

    def isValidator(self, signer: bytes) -> bool:
        if self.quorum() == 1:
            return signer in self.jurors()
        return any(stand_in(chosen) == signer for chosen in combinations(self.jurors(), self.quorum()))

    def collect(self, value: int) -> None:
        if self.sender != self.keeper():
            raise refused("NotTheKeeper", self.sender)
        ModelToken(self.run, self.xrt(), self.address).transfer(self.keeper(), value)


def stand_in(signers: Sequence[bytes]) -> bytes:
    """The address that stands for several signers."""
    return keccak256(b"".join(map(word, signers)))[12:]
