"""Histories of calls, valid and not, that are made on the EVM and on the model, and compared."""

from __future__ import annotations

import random
from functools import cache
from typing import Any, Final

from mesh.chain import XRT
from mesh.chain._names import namehash
from schemas import keccak256
from tests.simulation.model_abi import encode, functions, word
from tests.simulation.model_twins import PEOPLE, REFUND_DELAY, TIMEOUT, Outcome, Twins, call_of, reads

NOBODY: Final = bytes(20)
CREATED: Final = keccak256(b"NewLiability(address)")
REFUSED: Final = keccak256(b"PaymentRefused(address,address,uint256)")
LIGHTHOUSE: Final = keccak256(b"NewLighthouse(address,string)")
RESULT: Final = bytes.fromhex("1220") + keccak256(b"result")
KINDS: Final = {
    "ens": "ENSRegistry",
    "resolver": "Resolver",
    "xrt": "XRT",
    "other": "XRT",
    "blocking": "BlockingToken",
    "factory": "Factory",
    "lighthouse": "Lighthouse",
    "jury": "Jury",
    "panel": "Jury",
}
AMOUNTS: Final = (0, 1, 1, XRT - 1, XRT, XRT, 2 * XRT, 5 * XRT, 40 * XRT, 10**6 * XRT, 2**96, 2**128, 2**256 - 1)
NAMES: Final = (b"airalab", b"tower", b"a", b"", b"-a", b"ab--c", b"Upper", b"x" * 33, "\u00e4".encode())


@cache
def twins() -> Twins:
    """Both, deployed once."""
    return Twins()


class ModelHistory:
    """One history: draws what is done, does it to both, and compares."""

    def __init__(self, seed: int, steps: int) -> None:
        self.chance = random.Random(seed)
        self.steps = steps
        self.twins = twins()
        self.twins.begin()
        self.known = dict(self.twins.addresses)
        self.lighthouses = [self.known["lighthouse"]]
        self.made: list[tuple[bytes, dict[str, Any]]] = []
        self.sent: list[tuple[bytes, bytes, bytes]] = []
        self.hashes: list[bytes] = [bytes(32)]
        self.debts: list[tuple[bytes, bytes]] = []
        self.nonces = 0

    def play(self) -> None:
        actions = [
            self.token, self.token, self.stake, self.stake, self.create, self.create, self.create, self.create,
            self.finish, self.finish, self.finish, self.end, self.withdraw, self.name, self.jury, self.lighthouse,
            self.refuse, self.claim, self.again, self.again, self.spoil, self.spoil, self.garbage, self.wait,
        ]  # fmt: skip
        for person in self.chance.sample(self.twins.people, 3):
            self.do(person, self.known["lighthouse"], call_of("Lighthouse", "refill", 3 * XRT))
        for who in self.chance.sample((1, 2, 3), 2):
            data = call_of("BlockingToken", "setBlocked", self.twins.people[who], True)
            self.do(self.person(), self.known["blocking"], data)
        for _ in range(self.steps):
            self.pick(*actions)()
        self.compare_everything()

    def pick(self, *choices: Any) -> Any:
        return self.chance.choice(choices)

    def person(self) -> bytes:
        person: bytes = self.pick(*self.twins.people)
        return person

    def anybody(self) -> bytes:
        address: bytes = self.pick(*self.twins.people, *self.known.values(), NOBODY, b"\x11" * 20)
        return address

    def amount(self) -> int:
        amount: int = self.pick(*AMOUNTS)
        return amount

    def do(self, sender: bytes, to: bytes, data: bytes, *, value: int = 0) -> Outcome:
        """Do something to both."""
        self.sent.append((sender, to, data))
        expected, found = self.twins.call(sender, to, data, value=value)
        assert found == expected, f"{sender.hex()} to {to.hex()}: {data.hex()}"
        for _, topics, _ in found.logs:
            if topics[0] == LIGHTHOUSE:
                self.lighthouses.append(topics[1][12:])
            if topics[0] == REFUSED:
                self.debts.append((topics[1][12:], topics[2][12:]))
        return found

    def wait(self) -> None:
        self.twins.pass_blocks(self.pick(1, 1, TIMEOUT, TIMEOUT + 1, 2 * TIMEOUT + 1, REFUND_DELAY))

    def token(self) -> None:
        token, name = (
            self.known[self.pick("xrt", "xrt", "other")],
            self.pick("approve", "transfer", "transferFrom", "mint", "setMinter"),
        )
        values: tuple[Any, ...] = (self.anybody(), self.amount())
        if name == "transferFrom":
            values = (self.anybody(), *values)
        elif name == "setMinter":
            values = values[:1]
        self.do(self.person(), token, call_of("XRT", name, *values))

    def stake(self) -> None:
        lighthouse, person = self.pick(*self.lighthouses), self.person()
        if lighthouse != self.known["lighthouse"]:
            self.do(person, self.known["xrt"], call_of("XRT", "approve", lighthouse, 2**256 - 1))
        name, value = self.pick("refill", "refill", "withdraw"), self.pick(XRT, 2 * XRT, self.amount())
        self.do(person, lighthouse, call_of("Lighthouse", name, value))

    def lighthouse(self) -> None:
        values = (self.pick(XRT, self.amount()), self.pick(1, 5, 0, 2**32), self.pick(*NAMES))
        self.do(self.person(), self.known["factory"], call_of("Factory", "createLighthouse", *values))

    def orders(self, terms: dict[str, Any]) -> tuple[bytes, bytes]:
        """A demand and an offer, signed, with a flaw at times."""
        flaw = self.pick(*[""] * 40, "model", "objective", "token", "cost", "swap", "lighthouse", "generation")
        found = []
        for kind, who in (("demand", terms["promisee"]), ("offer", terms["promisor"])):
            one = dict(terms)
            if kind == "offer" and flaw in ("model", "objective"):
                one[flaw] = bytes.fromhex("1220") + keccak256(b"another")
            if kind == "offer" and flaw in ("token", "lighthouse"):
                one[flaw] = self.anybody()
            if kind == "offer" and flaw == "cost":
                one["cost"] += 1
            if kind == "offer" and flaw == "generation":
                one["generation"] = 8 - one["generation"]
            found.append(self.order(kind, who, one))
        if flaw == "swap":
            found.reverse()
        return found[0], found[1]

    def order(self, kind: str, who: int, terms: dict[str, Any]) -> bytes:
        accounts = [terms["lighthouse"], terms["validator"]]
        fee = terms["validator_fee"] if kind == "demand" else terms["lighthouse_fee"]
        if kind == "offer":
            accounts.reverse()
        deadline = self.twins.height + self.pick(*[100] * 20, 0, 1, 2)
        packed = terms["model"] + terms["objective"] + terms["token"] + word(terms["cost"])
        packed += b"".join(accounts) + word(fee) + word(deadline)
        person = self.twins.people[who]
        if terms["generation"] == 3:
            self.nonces += 1
            last = keccak256(word(self.nonces))
            digest = keccak256(packed + last)
        else:
            last, nonce = word(person), self.nonce(person)
            is_second = kind == "offer" and terms["promisee"] == terms["promisor"]
            digest = keccak256(packed + word(nonce + is_second) + person)
        self.hashes.append(digest)
        signer = self.twins.signers[self.pick(*[who] * 40, (who + 1) % PEOPLE)]
        signature = signer.sign_hash(digest)
        if self.pick(*[False] * 40, True):
            signature = self.pick(signature[:64] + b"\0", signature[:64], bytes(65), signature[:32] + b"\xff" * 33)
        types = ("bytes", "bytes", "address", "uint256", "address", "address", "uint256", "uint256", "bytes32", "bytes")
        values = (
            terms["model"],
            terms["objective"],
            terms["token"],
            terms["cost"],
            *accounts,
            fee,
            deadline,
            last,
            signature,
        )
        return encode(types, values)

    def nonce(self, person: bytes) -> int:
        data = call_of("Factory", "nonceOf", person)
        return int.from_bytes(self.twins.call(person, self.known["factory"], data, keep=False)[1].data, "big")

    def create(self, **changes: Any) -> None:
        """A liability, with these changes of its terms."""
        terms: dict[str, Any] = {
            "generation": self.pick(3, 5),
            "model": bytes.fromhex("1220") + keccak256(b"model"),
            "objective": bytes.fromhex("1220") + keccak256(self.pick(b"objective", b"more")),
            "token": self.pick(
                *[self.known["xrt"]] * 12, *[self.known["other"]] * 4, *[self.known["blocking"]] * 8, self.anybody()
            ),
            "cost": self.pick(0, 1, XRT, XRT, XRT, 3 * XRT, self.amount()),
            "lighthouse": self.pick(*[self.known["lighthouse"]] * 12, *self.lighthouses[-2:]),
            "validator": self.pick(
                *[NOBODY] * 12,
                *[self.known["jury"]] * 3,
                *[self.known["panel"]] * 3,
                *[self.twins.people[5]] * 3,
                self.anybody(),
                self.lighthouses[-1],
            ),
            "validator_fee": self.pick(0, 0, 1, XRT),
            "lighthouse_fee": self.pick(0, 0, 1, XRT),
            "promisee": self.pick(1, 1, 2),
            "promisor": self.pick(2, 3, 1),
        } | changes
        demand, offer = self.orders(terms)
        to = self.pick(*[terms["lighthouse"]] * 24, self.known["lighthouse"], self.known["factory"])
        done = self.do(self.provider(to), to, call_of("Lighthouse", "createLiability", demand, offer))
        self.made += [(topics[1][12:], terms) for _, topics, _ in done.logs if topics[0] == CREATED]

    def provider(self, lighthouse: bytes) -> bytes:
        """Mostly the one whose turn it is."""
        current = self.twins.call(NOBODY, lighthouse, call_of("Lighthouse", "current"), keep=False)[1].data[12:]
        provider: bytes = self.pick(*[current or NOBODY] * 40, *self.twins.people)
        return provider

    def result(self, liability: bytes, terms: dict[str, Any]) -> tuple[bytes, bool, bytes]:
        success, result = (
            self.pick(True, True, False),
            self.pick(*[RESULT] * 10, RESULT[:33], bytes(34), RESULT[:33] + b"\0"),
        )
        digest = keccak256(liability + RESULT + bytes([success if self.pick(*[True] * 9, False) else not success]))
        if self.pick(False, terms["validator"] == self.known["panel"]):
            signers = sorted(self.chance.sample(range(3, PEOPLE), 2), key=lambda who: self.twins.people[who])
            signers = self.pick(*[signers] * 6, signers[::-1], signers[:1] * 2, [2, *signers], [*signers, 1])
        else:
            signers = [self.pick(*[terms["promisor"]] * 6, terms["promisee"], 3, 4, 5)]
        signatures = b"".join(self.twins.signers[who].sign_hash(digest) for who in signers)
        return result, success, self.pick(*[signatures] * 20, signatures[:-1], signatures + b"\0")

    def finish(self) -> None:
        if not self.made:
            return
        liability, terms = self.pick(*self.made)
        result = self.result(liability, terms)
        sender, to = self.provider(terms["lighthouse"]), terms["lighthouse"]
        way = self.pick("finalizeLiability", "finalizeLiability", "to", "factory", "validator", "direct")
        if way == "finalizeLiability":
            data = call_of("Lighthouse", way, liability, *result)
        elif way == "to":
            inner = call_of("Liability", "finalize", *result, True)
            data = call_of("Lighthouse", way, liability, self.pick(inner, inner, inner[:-32], inner[:3], inner[1:]))
        elif way == "factory":
            to, data = self.known["factory"], call_of("Factory", "finalize", liability, *result)
        elif way == "validator":
            sender, to = self.pick(self.twins.people[5], self.person()), liability
            data = call_of("Liability", "finalize", *result, self.pick(True, False))
        else:
            to, data = self.known["factory"], call_of("Factory", "finalizeLiability", liability, *result)
        self.do(sender, to, data)

    def end(self) -> None:
        """By a refund or a cancellation, or what the factory alone may ask of a liability."""
        liability, terms = self.pick(*self.made * 10, (self.anybody(), {"promisee": 1, "promisor": 2}))
        signers = [terms["promisee"], self.pick(terms["promisor"], terms["promisor"], 0)]
        signatures = [self.twins.signers[who].sign_hash(keccak256(liability + b"cancel")) for who in signers]
        calls = {
            "refund": (self.known["factory"], call_of("Factory", "refund", liability)),
            "cancel": (self.known["factory"], call_of("Factory", "cancel", liability, *signatures)),
            "settle": (liability, call_of("Liability", "settleByFactory", RESULT[2:], True)),
            "ask": (
                liability,
                call_of("Liability", "askValidator", self.known[self.pick("jury", "panel")], self.person()),
            ),
        }
        self.do(self.person(), *calls[self.pick("refund", "refund", "cancel", "settle", "ask")])

    def refuse(self) -> None:
        """A token refuses to pay a party from now on, or pays it again."""
        values = self.pick(1, 2, 3), self.pick(True, True, False)
        data = call_of("BlockingToken", "setBlocked", self.twins.people[values[0]], values[1])
        if self.pick(True, False):
            data = call_of("BlockingToken", "setRefusal", self.pick(0, 1, 2, 3, 4))
        self.do(self.person(), self.known["blocking"], data)

    def claim(self) -> None:
        token, account = self.pick(*self.debts * 10, (self.known["blocking"], self.person()))
        calls = (
            call_of("Factory", "claim", token, account),
            call_of("Factory", "claimTo", token, self.anybody()),
            call_of("Factory", "pay", token, account, self.amount()),
        )
        self.do(self.pick(account, self.person()), self.known["factory"], self.pick(*calls[:2], *calls))

    def withdraw(self) -> None:
        person = self.person()
        if self.pick(True, False):
            data = call_of("Factory", "withdrawOrder", self.pick(*self.hashes))
        else:
            data = call_of("Factory", "withdrawNonce", self.pick(self.nonce(person), 0, 1))
        self.do(person, self.known["factory"], data)

    def name(self) -> None:
        """The registry and the resolver."""
        node = self.pick(
            namehash("eth"), namehash("3.robonomics.eth"), bytes(32), keccak256(namehash("eth") + bytes(32))
        )
        calls = (
            ("ens", "setOwner", (node, self.anybody())),
            ("ens", "setResolver", (node, self.anybody())),
            ("ens", "setTTL", (node, self.pick(0, 2**64 - 1))),
            ("ens", "setSubnodeOwner", (node, bytes(32), self.anybody())),
            ("ens", "setSubnodeRecord", (node, bytes(32), self.anybody(), self.anybody(), 7)),
            ("resolver", "setAddr", (node, self.anybody())),
            ("resolver", "setMultihash", (node, self.pick(b"", RESULT))),
            ("resolver", "supportsInterface", (self.pick(bytes(4), bytes.fromhex("01ffc9a7")),)),
        )
        contract, function, values = self.pick(*calls)
        sender = self.pick(self.twins.people[0], self.person())
        self.do(sender, self.known[contract], call_of(KINDS[contract], function, *values))

    def jury(self) -> None:
        sender = self.pick(self.twins.people[0], self.person())
        jury = self.known[self.pick("jury", "panel")]
        self.do(sender, jury, call_of("Jury", "collect", self.pick(0, 1, XRT)))

    def again(self) -> None:
        """What was sent before, by the same or another account, perhaps with ether."""
        if self.sent:
            sender, to, data = self.pick(*self.sent)
            self.do(self.pick(sender, sender, self.person()), to, data, value=self.pick(0, 0, 0, 1))

    def spoil(self) -> None:
        """The same with a byte more, less or changed."""
        if self.sent:
            sender, to, data = self.pick(*self.sent)
            at = self.chance.randint(0, len(data))
            changed = (
                data[:at],
                data + bytes(at % 40),
                data[:at] + bytes([self.pick(1, 32, 255)]) + data[at + 1 :],
                data[: at - at % 32 + 4] + b"\xff" * 32 + data[at - at % 32 + 36 :],
            )
            self.do(sender, to, self.pick(*changed))

    def garbage(self) -> None:
        """Any function of any contract with any words."""
        to = self.pick(*self.known)
        selector = self.pick(*functions(KINDS[to]))
        words = self.chance.choices((0, 1, 64, 2**64, 2**255), k=self.pick(0, 1, 2, 3))
        self.do(self.person(), self.known[to], selector + b"".join(map(word, words)))

    def compare_everything(self) -> None:
        """All view functions, with arguments that matter, and the code of what was made."""
        contracts = [(address, KINDS[name]) for name, address in self.known.items()]
        contracts += [(address, "Lighthouse") for address in self.lighthouses[1:]]
        contracts += [(address, "Liability") for address, _ in self.made]
        accounts = [*self.twins.people, *self.known.values(), *(address for address, _ in self.made[:3])]
        for address, kind in contracts:
            for data in reads(kind, accounts, self.hashes):
                expected, found = self.twins.call(self.twins.people[0], address, data, keep=False)
                assert found == expected, f"{kind} {data.hex()}"
        for address in self.lighthouses + [address for address, _ in self.made]:
            expected_code, code = self.twins.code(address)
            assert code == expected_code
