"""ENS names."""

from __future__ import annotations

import pytest

from mesh.chain import Account, Chain, ContractNames, TransactionSender, UnknownName, deploy, namehash
from mesh.chain._names import root_of
from mesh.dev import EmbeddedChain
from schemas.cid import parse_cid
from schemas.errors import InvalidCid
from tests.mesh.chain.conftest import QUICK, cid


@pytest.mark.parametrize(
    ("name", "node"),
    [
        ("", "00" * 32),
        ("eth", "93cdeb708b7545dc668eb9280176169d1c33cfd8ed6f04690a0bcc88a93fc4ae"),
        ("foo.eth", "de9b09fd7c5f901e23a3f19fecc54828e9c848539801e86591bd9801b019f84f"),
    ],
)
def test_namehash_is_that_of_eip_137(name: str, node: str) -> None:
    assert namehash(name).hex() == node


@pytest.mark.parametrize(
    ("name", "root"),
    [
        ("airalab.lighthouse.3.robonomics.eth", "3.robonomics.eth"),
        ("xrt.5.robonomics.eth", "5.robonomics.eth"),
        ("3.robonomics.eth", "3.robonomics.eth"),
        ("robonomics.eth", "robonomics.eth"),
        ("somebody.eth", "somebody.eth"),
        ("a.b.c.eth", "a.b.c.eth"),
    ],
)
def test_names_of_the_network_are_resolved_at_their_root(name: str, root: str) -> None:
    assert root_of(name) == root


def _content_resolver(multihash: bytes) -> bytes:
    """Code that deploys a resolver that answers every call with one multihash."""
    words = (32, 34, int.from_bytes(multihash[:32], "big"), int.from_bytes(multihash[32:].ljust(32, b"\0"), "big"))
    stores = b"".join(
        b"\x7f" + word.to_bytes(32, "big") + bytes((0x60, 32 * at, 0x52)) for at, word in enumerate(words)
    )
    code = stores + bytes.fromhex("60806000f3")
    return bytes((0x60, len(code), 0x60, 12, 0x60, 0, 0x39, 0x60, len(code), 0x60, 0, 0xF3)) + code


async def test_a_model_is_a_cid_or_a_name_of_one() -> None:
    async with EmbeddedChain() as node:
        account = Account(node.funded_keys[0])
        deployment = await deploy(node.provider, account)
        contracts = ContractNames(factory=deployment.factory, xrt=deployment.xrt)
        async with Chain(node.provider, account=account, contracts=contracts, timing=QUICK) as chain:
            assert await chain.names.model(cid(1)) == cid(1)
            with pytest.raises(InvalidCid):
                await chain.names.model("Qm")
            with pytest.raises(UnknownName):
                await chain.names.model("sensor.model.5.robonomics.eth")
            sender = TransactionSender(chain.node, account)
            resolver = (await sender.send(to=None, data=_content_resolver(parse_cid(cid(1))))).contract
            registry = chain.node.contract("ENSRegistry", chain.ens)
            await sender.call(registry.setResolver(namehash("3.robonomics.eth"), resolver))
            assert await chain.names.model("Sensor.model.3.robonomics.eth") == cid(1)
