"""Making lighthouses, and the ENS names by which clients find everything."""

from __future__ import annotations

import json
import shutil
import subprocess
from itertools import product
from random import Random
from typing import Final

import pytest
from web3.logs import DISCARD

from mesh.cli.lighthouse import LABEL
from schemas import keccak256
from tests.support.contracts.chains import py_evm
from tests.support.contracts.evm import Evm
from tests.support.contracts.suite import XRT, Suite, namehash
from tests.support.peers import require

ZERO = "0x" + "00" * 20


@pytest.mark.parametrize("generation", [3, 5])
def test_both_generations_find_the_same_contracts(suite: Suite, generation: int) -> None:
    lighthouse = suite.create_lighthouse(name="airalab")
    root = f"{generation}.robonomics.eth"
    assert suite.ens.functions.resolver(namehash(root)).call() == suite.resolver.address
    for name, contract in (("xrt", suite.xrt), ("factory", suite.factory), ("airalab.lighthouse", lighthouse)):
        node = namehash(f"{name}.{root}")
        assert suite.ens.functions.resolver(node).call() == suite.resolver.address
        assert suite.resolver.functions.addr(node).call() == contract.address


def test_an_unknown_name_answers_zero(suite: Suite) -> None:
    assert suite.address_of("nobody.lighthouse.3.robonomics.eth") == ZERO
    assert suite.address_of("robonomics.eth") == ZERO
    assert suite.ens.functions.resolver(namehash("nobody.5.robonomics.eth")).call() == ZERO
    assert suite.ens.functions.owner(namehash("nobody.5.robonomics.eth")).call() == ZERO


def test_a_new_lighthouse_is_announced_and_known(suite: Suite) -> None:
    receipt = suite.send(suite.factory.functions.createLighthouse(2 * XRT, 7, "new-one"))
    (event,) = suite.factory.events.NewLighthouse().process_receipt(receipt, errors=DISCARD)
    assert event["args"]["name"] == "new-one"
    lighthouse = suite.contract("Lighthouse", event["args"]["lighthouse"])
    functions = lighthouse.functions
    assert suite.factory.functions.isLighthouse(lighthouse.address).call()
    assert not suite.factory.functions.isLiability(lighthouse.address).call()
    settings = functions.minimalStake().call(), functions.timeoutInBlocks().call(), functions.name().call()
    assert settings == (2 * XRT, 7, "new-one")
    assert functions.factory().call() == suite.factory.address
    assert functions.xrt().call() == suite.xrt.address


def test_implementations_and_other_addresses_are_not_lighthouses(suite: Suite) -> None:
    factory = suite.factory.functions
    implementation = suite.implementation(suite.create_lighthouse(name="cloned"))
    for address in (implementation, suite.xrt.address, suite.deployer.address, ZERO):
        assert not factory.isLighthouse(address).call()
        assert not factory.isLiability(address).call()


def test_a_name_is_taken_once(suite: Suite) -> None:
    create = suite.factory.functions.createLighthouse
    suite.send(create(XRT, 10, "taken"))
    for stake, timeout in ((XRT, 10), (2 * XRT, 10), (XRT, 11)):
        refusal = suite.chain.refusal(create(stake, timeout, "taken"), suite.deployer.address)
        assert refusal == ("NameTaken", "taken")
    receipt = suite.attempt(create(XRT, 10, "taken"))
    assert receipt["gasUsed"] < 60_000, "a refusal must not take the whole limit"


NOT_NORMAL = ["-", "-a", "a-", "--", "ab--", "ab--cd", "xn--a", "xn--nxasmq6b", "a---b"]


@pytest.mark.parametrize("name", ["", "Airalab", "a.b", "a b", "aira_lab", "é", "a" * 33, *NOT_NORMAL])
def test_a_name_is_one_plain_label(suite: Suite, name: str) -> None:
    call = suite.factory.functions.createLighthouse(XRT, 10, name)
    assert suite.chain.refusal(call, suite.deployer.address) == ("InvalidName", name)


NORMALIZE: Final = """
const { normalize } = require("eth-ens-namehash");
const names = JSON.parse(require("fs").readFileSync(0, "utf8"));
const unchanged = (name) => { try { return normalize(name) === name; } catch { return false; } };
console.log(JSON.stringify(names.map(unchanged)));
"""


def test_names_are_those_that_ens_normalization_leaves_unchanged() -> None:
    """The JavaScript library of the legacy clients, asked about all short names and some at random."""
    folder, node = require("robonomics-5"), shutil.which("node")
    assert node
    chance = Random(5)
    names = ["".join(letters) for size in range(1, 5) for letters in product("a0-x", repeat=size)]
    names += ["".join(chance.choices("abn0-x_", k=chance.randint(1, 32))) for _ in range(100)]
    names += [*NOT_NORMAL, *(chr(code) for code in range(33, 127) if chr(code) != "."), "a" * 32, "ab-cd", "a--b"]
    asked = subprocess.run(
        [node, "-e", NORMALIZE], input=json.dumps(names), cwd=folder, capture_output=True, text=True, check=True
    )
    unchanged = dict(zip(names, json.loads(asked.stdout), strict=True))

    suite = Suite(py_evm())
    evm, caller = Evm(suite.chain), suite.deployer.address
    for name, is_normal in unchanged.items():
        evm.rewind()
        create = "createLighthouse(uint256,uint256,string)"
        answer = evm.call(suite.factory.address, create, XRT, 10, name, sender=caller)
        assert answer.refusal == (None if is_normal else "InvalidName"), name
        assert bool(LABEL.fullmatch(name)) == is_normal, name


@pytest.mark.parametrize(
    ("stake", "timeout", "refusal"),
    [
        (0, 10, ("InvalidStake", 0)),
        (2**128, 10, ("InvalidStake", 2**128)),
        (XRT, 0, ("InvalidTimeout", 0)),
        (XRT, 2**32, ("InvalidTimeout", 2**32)),
    ],
)
def test_stake_and_timeout_have_bounds(suite: Suite, stake: int, timeout: int, refusal: tuple[object, ...]) -> None:
    call = suite.factory.functions.createLighthouse(stake, timeout, "bounds")
    assert suite.chain.refusal(call, suite.deployer.address) == refusal


def test_the_name_of_a_lighthouse_can_not_be_pointed_elsewhere(suite: Suite) -> None:
    suite.create_lighthouse(name="mine")
    node = namehash("mine.lighthouse.5.robonomics.eth")
    thief = suite.people[1].address
    for call in (suite.resolver.functions.setAddr(node, thief), suite.ens.functions.setOwner(node, thief)):
        for person in (suite.deployer.address, thief):
            assert suite.chain.refusal(call, person) == ("NotTheOwner", node, person)


def test_owners_of_names_have_the_rights_of_ens(suite: Suite) -> None:
    registry, owner = suite.ens.functions, suite.people[1]
    root, node = namehash("robonomics.eth"), namehash("sub.robonomics.eth")
    suite.send(registry.setSubnodeOwner(root, keccak256(b"sub"), owner.address))
    assert registry.recordExists(node).call()
    suite.send(registry.setResolver(node, suite.resolver.address), owner)
    suite.send(registry.setTTL(node, 60), owner)
    suite.send(suite.resolver.functions.setAddr(node, suite.xrt.address), owner)
    assert (registry.ttl(node).call(), suite.address_of("sub.robonomics.eth")) == (60, suite.xrt.address)
    suite.send(registry.setResolver(node, ZERO), owner)
    suite.send(registry.setOwner(node, suite.deployer.address), owner)
    assert (registry.resolver(node).call(), registry.owner(node).call()) == (ZERO, suite.deployer.address)
    assert suite.chain.refusal(registry.setTTL(node, 1), owner.address) == ("NotTheOwner", node, owner.address)


def test_a_name_can_stand_for_a_model(suite: Suite) -> None:
    node, model = namehash("robonomics.eth"), b"\x12\x20" + bytes(range(32))
    resolver = suite.resolver.functions
    assert resolver.multihash(node).call() == b""
    suite.send(resolver.setMultihash(node, model))
    assert resolver.multihash(node).call() == model
    thief = suite.people[1].address
    assert suite.chain.refusal(resolver.setMultihash(node, b""), thief) == ("NotTheOwner", node, thief)


@pytest.mark.parametrize(
    ("interface", "known"), [("01ffc9a7", True), ("3b3b57de", True), ("e89401a1", True), ("ffffffff", False)]
)
def test_the_resolver_reports_its_interfaces(suite: Suite, interface: str, known: bool) -> None:
    assert suite.resolver.functions.supportsInterface(bytes.fromhex(interface)).call() == known
