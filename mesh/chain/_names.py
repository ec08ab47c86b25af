"""ENS names, looked up with two calls.

Names under a root (`N.robonomics.eth`) are resolved by the root's resolver, which is looked up once, as every client of
the network does. web3's own helper needs a universal resolver, which a private chain lacks.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.base.flood import BoundedDict
from mesh.chain._abi import ContractFunctions, functions_of
from mesh.chain.errors import NoContracts, Reverted, UnknownName
from mesh.errors import InputError
from schemas import keccak256
from schemas.address import ZERO_ADDRESS, is_ens_name, parse_address
from schemas.cid import format_cid, parse_cid
from schemas.errors import InvalidAddress, InvalidCid

if TYPE_CHECKING:
    from mesh.chain._node import Node

PUBLIC_REGISTRY: Final = "0x00000000000C2E074eC69A0dFb2997BA6C7d2e1e"
"""The ENS registry of the public networks."""

DEVELOPMENT_REGISTRY: Final = "0x5FbDB2315678afecb367f032d93F642f64180aa3"
"""Where `deploy` puts the registry when the first account of a development chain deploys first."""

GENERATIONS: Final = (3, 5)
MULTIHASH_ABI: Final = (
    {
        "type": "function",
        "name": "multihash",
        "stateMutability": "view",
        "inputs": [{"name": "node", "type": "bytes32"}],
        "outputs": [{"name": "", "type": "bytes"}],
    },
)
"""The function of the public resolver of 2018 for names of content; not every resolver has it."""


class NameLimits(NamedTuple):
    """What is remembered of names, which come from strangers' messages, too."""

    remembered: int = 256
    """Resolvers, each for the root of names; and addresses."""
    seconds: float = 300.0
    """How long the address of a name is used before it is looked up again."""


NAME_LIMITS: Final = NameLimits()


def namehash(name: str) -> bytes:
    """The 32-byte node of a name (EIP-137); the empty name is the root."""
    node = bytes(32)
    for label in reversed(name.split(".")) if name else ():
        node = keccak256(node + keccak256(label.encode()))
    return node


def root_of(name: str) -> str:
    """The name whose resolver knows `name`: `3.robonomics.eth` for all below it, elsewhere the name itself."""
    return ".".join(name.split(".")[-3:]) if name.endswith(".robonomics.eth") else name


class Names:
    """ENS names on the chain behind `node`, by the registry at the address `registry`.

    The `generation` is the root of names that are given by their label only.
    """

    def __init__(self, node: Node, registry: str, generation: int) -> None:
        self.registry = registry
        self._generation = generation
        self._node = node
        self._resolvers: BoundedDict[str, str] = BoundedDict(NAME_LIMITS.remembered)
        self._addresses: BoundedDict[str, tuple[str, float]] = BoundedDict(NAME_LIMITS.remembered)

    async def address(self, name_or_address: str) -> str:
        """The address of a name, or the given address itself; EIP-55.

        Raises `InputError` (`invalid-name`), `InvalidAddress`, `UnknownName`, `NodeUnreachable`.
        """
        if not is_ens_name(name_or_address):
            return _parse_address(name_or_address)
        name = name_or_address.lower()
        known, until = self._addresses.get(name, ("", 0.0))
        if time.monotonic() < until:
            return known
        resolver = self._node.contract("Resolver", await self._resolver(name))
        address = str(await self._node.read(resolver.addr(namehash(name))))
        if address == ZERO_ADDRESS:
            raise UnknownName(name)
        self._addresses[name] = address, time.monotonic() + NAME_LIMITS.seconds
        return address

    async def model(self, name_or_cid: str) -> str:
        """The CID of a model behind a name (`NAME.model.N.robonomics.eth`), or the given CID itself.

        Raises `InvalidCid` for a text that is neither, `UnknownName`, `NodeUnreachable`.
        """
        if not is_ens_name(name_or_cid):
            parse_cid(name_or_cid)
            return name_or_cid
        name = name_or_cid.lower()
        resolver = ContractFunctions(await self._resolver(name), functions_of(MULTIHASH_ABI))
        try:
            return format_cid(bytes(await self._node.read(resolver.multihash(namehash(name)))))
        except (InvalidCid, Reverted):
            raise UnknownName(name) from None

    async def lighthouse(self, name_or_address: str) -> str:
        """The address of a lighthouse; a label alone (`airalab`) is a name under the generation's root."""
        is_label = "." not in name_or_address and not name_or_address.startswith("0x")
        root = f".lighthouse.{self._generation}.robonomics.eth" if is_label else ""
        return await self.address(name_or_address + root)

    async def _resolver(self, name: str) -> str:
        root = root_of(name)
        if root not in self._resolvers:
            registry = self._node.contract("ENSRegistry", self.registry)
            resolver = str(await self._node.read(registry.resolver(namehash(root))))
            if resolver == ZERO_ADDRESS:
                raise UnknownName(name)
            self._resolvers[root] = resolver
        return self._resolvers[root]


async def find_registry(node: Node, ens: str) -> str:
    """The ENS registry to use: the given one, else the public one or that of a development chain.

    Raises `NoContracts`, `InvalidAddress`, `NodeUnreachable`.
    """
    candidates = (parse_address(ens),) if ens else (PUBLIC_REGISTRY, DEVELOPMENT_REGISTRY)
    for candidate in candidates:
        if await node.code(candidate):
            return candidate
    raise NoContracts("ENS registry" + (f" at {ens}" if ens else ""), node.chain_id)


def _parse_address(text: str) -> str:
    try:
        return parse_address(text)
    except InvalidAddress:
        if "." in text:
            raise InputError(
                f"{text[:80]!r} is not an ENS name",
                hint="names end in .eth, .sid or .test, and hold ASCII letters, digits, - and _",
                code="invalid-name",
            ) from None
        raise
