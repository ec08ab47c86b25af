"""`aira liability`: show, list, watch, cancel."""

from __future__ import annotations

import json
import signal
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT, TransactionSender
from mesh.chain.errors import NotALiability
from mesh.errors import InvalidAddress
from schemas import Liability
from tests.support.cli.served_chain import REFUND_DELAY, ServedChain, columns
from tests.support.commands import AIRA, Interrupted, Serving, aira, refused
from tests.support.tokens import block, deploy_blocking_token

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.chain import BlockHeader, Chain

COST = 1_500_000_000


def held(served: ServedChain, role: str) -> int:
    return served.ask(role, lambda chain: chain.tokens.balance())


def signature_of(served: ServedChain, role: str, liability: str) -> str:
    signature: str = served.run_json("liability", "cancel", liability, by=role)["signature"]
    return signature


def test_an_open_liability_is_shown_with_its_cost_and_the_block_from_which_it_is_refundable(
    served: ServedChain,
) -> None:
    address = served.create_liability(cost=COST, lighthouse_fee=7)
    head = served.ask("person", lambda chain: chain.block_number())
    said = columns(served.aira("liability", "show", address).stdout)
    assert said["state"] == "open: the contract holds the cost"
    assert said["promisee"] == f"{served.people['person'].address}  (you)"
    assert said["promisor"] == served.people["robot"].address
    assert (said["cost"], said["token"]) == ("1.5 XRT", served.deployment.xrt)
    assert said["lighthouse"] == f"{served.deployment.lighthouse}  for 0.000000007 XRT"
    assert said["validator"] == "none"
    assert said["refund"] == f"possible from block {head + REFUND_DELAY:,}, in {REFUND_DELAY} blocks"
    assert "result" not in said


def test_json_is_the_record_on_the_mesh_with_a_state(served: ServedChain) -> None:
    address = served.create_liability(cost=COST)
    shown = served.run_json("liability", "show", address)
    assert (shown.pop("state"), shown.pop("refundableFrom") > 0) == ("open", True)
    record = Liability.decode(json.dumps(shown).encode())
    assert record == served.ask("robot", lambda chain: chain.liabilities.get(address))
    cid = served.finalize(address)
    shown = served.run_json("liability", "show", address)
    assert (shown["state"], shown["result"], shown["refundableFrom"]) == ("paid", cid, None)


@pytest.mark.parametrize(("success", "state"), [(True, "paid: "), (False, "failed: ")])
def test_a_finalized_liability_is_shown_with_its_result(served: ServedChain, success: bool, state: str) -> None:
    address = served.create_liability(cost=COST)
    cid = served.finalize(address, success=success)
    said = columns(served.aira("liability", "show", address, by="stranger").stdout)
    assert said["state"].startswith(state)
    assert said["result"] == cid
    assert said["promisee"] == served.people["person"].address
    assert "refund" not in said


def test_showing_a_liability_needs_no_keyfile(served: ServedChain) -> None:
    address = served.create_liability()
    assert served.run_json("liability", "show", address, AIRA_KEYFILE="")["address"] == address


def test_the_list_has_the_accounts_liabilities_and_can_be_filtered(served: ServedChain) -> None:
    start = served.ask("person", lambda chain: chain.block_number()) + 1
    ended, opened = served.create_liability(cost=COST), served.create_liability()
    served.finalize(ended)

    def listed(*options: str, by: str = "person") -> list[str]:
        found = served.run_json("liability", "list", "--from-block", str(start), *options, by=by)
        return [liability["address"] for liability in found]

    assert listed() == listed(by="robot") == [ended, opened]
    assert listed("--state", "open") == [opened]
    assert listed("--state", "finalized") == [ended]
    assert listed(by="stranger") == []
    assert listed("--all", by="stranger") == [ended, opened]
    assert listed("--account", served.people["robot"].address, by="stranger") == [ended, opened]
    said = served.aira("liability", "list", "--from-block", str(start), by="robot").stdout
    head, first, second, *sums = (line.split() for line in said.splitlines())
    assert head == ["CREATED", "ENDED", "LIABILITY", "STATE", "COST", "PROMISEE", "PROMISOR"]
    person = served.people["person"].address
    assert first[4:] == [ended, "paid", "1.5", "XRT", f"{person[:6]}…{person[-4:]}", "you"]
    assert second[2:7] == ["-", opened, "open", "0", "XRT"]
    assert [" ".join(line) for line in sums] == ["1 contract open: 0 XRT", "1 contract paid: 1.5 XRT"]


async def block_of(chain: Chain, number: int) -> BlockHeader:
    header = await chain.node.header(number)
    assert header is not None
    return header


def test_the_list_says_when_contracts_were_created_and_ended(served: ServedChain) -> None:
    start = served.ask("person", lambda chain: chain.block_number()) + 1
    address = served.create_liability(cost=COST)
    opened = served.run_json("liability", "list", "--from-block", str(start))[0]
    served.finalize(address)
    ended = served.run_json("liability", "list", "--from-block", str(start))[0]
    assert (opened["created"], opened["ended"]) == (ended["created"], None)
    for step, number in ((ended["created"], start), (ended["ended"], start + 1)):
        header = served.ask("person", partial(block_of, number=number))
        assert step["block"] == number
        assert datetime.fromisoformat(step["time"]).timestamp() == header.timestamp
        assert header.transactions == [bytes.fromhex(step["tx"][2:])]
    said = served.aira("liability", "list", "--from-block", str(start)).stdout.splitlines()[1]
    assert said.startswith(ended["created"]["time"].replace("T", " ").replace("Z", "  "))


def test_without_an_account_all_liabilities_are_listed(served: ServedChain) -> None:
    address = served.create_liability()
    assert address in [liability["address"] for liability in served.run_json("liability", "list", AIRA_KEYFILE="")]


def test_an_empty_list_is_printed_as_a_sentence(served: ServedChain) -> None:
    stranger = served.people["stranger"].address
    done = served.aira("liability", "list", "--state", "open", by="stranger")
    assert (done.exit_code, done.stdout) == (0, f"no open liabilities of {stranger}\n")
    assert served.run_json("liability", "list", by="stranger") == []


def test_both_parties_cancel_a_liability(served: ServedChain) -> None:
    before = held(served, "person")
    address = served.create_liability(cost=COST)
    said = served.aira("liability", "cancel", address, by="robot").stdout
    command = said.splitlines()[-1]
    assert said.startswith(f"as the promisor, you agree to cancel {address}")
    assert served.people["person"].address in said
    assert command.startswith(f"aira liability cancel {address} --signature 0x")
    assert served.run_json("liability", "show", address)["state"] == "open", "one signature ends nothing"
    done = served.aira(*command.split()[1:], by="person")
    ended = columns(done.stdout)
    assert ended["state"].startswith("cancelled or refunded")
    assert ended["paid back"] == f"1.5 XRT  to {served.people['person'].address}"
    assert held(served, "person") == before
    assert served.run_json("liability", "show", address)["state"] == "called-off"


def test_anybody_can_cancel_with_both_signatures(served: ServedChain) -> None:
    address = served.create_liability(cost=COST)
    signatures = [word for role in ("robot", "person") for word in ("--signature", signature_of(served, role, address))]
    shown = served.run_json("liability", "cancel", address, *signatures, by="stranger")
    assert (shown["state"], shown["tx"][:2], shown["gasUsed"] > 0) == ("called-off", "0x", True)


def test_the_json_of_a_signature_names_the_other_signer(served: ServedChain) -> None:
    address = served.create_liability()
    shown = served.run_json("liability", "cancel", address)
    assert (shown["party"], shown["signer"]) == ("promisee", served.people["person"].address)
    assert shown["needed"] == served.people["robot"].address


def test_a_wrong_signature_is_one_clear_line(served: ServedChain) -> None:
    address, other = served.create_liability(), served.create_liability()
    mine = signature_of(served, "person", address)
    wrong = signature_of(served, "robot", other)
    cancel = ("liability", "cancel", address, "--signature")
    refused(served.aira(*cancel, mine), "signature-missing", "promisor")
    refused(served.aira(*cancel, wrong), "invalid-signature")
    refused(served.aira(*cancel, "0x12"), "invalid-signature")
    refused(served.aira(*cancel, "rubbish"), "invalid-signature")
    assert served.run_json("liability", "show", address)["state"] == "open"


def test_only_a_party_can_cancel(served: ServedChain) -> None:
    refused(served.aira("liability", "cancel", served.create_liability(), by="stranger"), "not-a-party")


def test_a_finalized_liability_can_not_be_cancelled(served: ServedChain) -> None:
    address = served.create_liability()
    served.finalize(address)
    refused(served.aira("liability", "cancel", address), "liability-ended", address, "paid")
    refused(served.aira("liability", "cancel", address, "--refund"), "liability-ended", address, "paid")


def test_the_cost_is_refunded_after_the_delay_when_the_promisor_disappeared(served: ServedChain) -> None:
    before = held(served, "person")
    address = served.create_liability(cost=COST)
    hint = refused(served.aira("liability", "cancel", address, "--refund"), "not-refundable", address)
    assert "both parties" in hint
    served.mine(REFUND_DELAY - 1)
    assert columns(served.aira("liability", "show", address).stdout)["refund"].startswith("possible now")
    said = columns(served.aira("liability", "cancel", address, "--refund", by="stranger").stdout)
    assert said["paid back"] == f"1.5 XRT  to {served.people['person'].address}"
    assert held(served, "person") == before


def test_a_refund_needs_no_signature(served: ServedChain) -> None:
    done = served.aira("liability", "cancel", served.create_liability(), "--refund", "--signature", "0x12")
    assert (done.exit_code, "--refund and --signature" in done.stderr) == (2, True)


def test_an_amount_of_another_token_is_not_printed_as_xrt(served: ServedChain) -> None:
    async def forge() -> str:
        async with served.chain("person") as chain:
            data = chain.node.creation_code("XRT", 1_000 * XRT)
            assert chain.account is not None
            receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=data)
            assert receipt.contract is not None
            await chain.tokens.approve(chain.factory, XRT, token=receipt.contract)
            return receipt.contract

    token = served.run(forge())
    address = served.create_liability(cost=7, token=token)
    said = columns(served.aira("liability", "show", address).stdout)
    assert said["cost"] == f"0.000000007 XRT ({token[:6]}…{token[-4:]})"
    assert said["token"] == token


def blocking(served: ServedChain) -> str:
    """A token of the person that refuses to pay the person."""

    async def deployed() -> str:
        async with served.chain("person") as chain:
            token = await deploy_blocking_token(chain, 1000)
            await block(chain, token, served.people["person"].address)
            return token

    return served.run(deployed())


def test_what_the_token_refused_to_return_is_shown_and_claimed(served: ServedChain) -> None:
    person, stranger = (served.people[role].address for role in ("person", "stranger"))
    token = blocking(served)
    address = served.create_liability(cost=7, token=token)
    assert "owed" not in served.run_json("liability", "show", address)
    refused(served.aira("liability", "claim", address), "nothing-owed", "has not ended")
    served.finalize(address, success=False)

    owed = columns(served.aira("liability", "show", address, by="stranger").stdout)["owed"]
    unit = f"units ({token[:6]}…{token[-4:]})"
    assert owed == f"7 {unit} to {person}, whom the token refused to pay: `aira liability claim {address}`"
    assert "--to" in refused(served.aira("liability", "claim", address, by="stranger"), "claim-refused", person)
    refused(served.aira("liability", "claim", address, "--to", stranger, by="stranger"), "not-a-party", person)

    said = columns(served.aira("liability", "claim", address, "--to", stranger).stdout)
    assert said["claimed"] == f"7 {unit}  to {stranger}"
    assert served.ask("stranger", lambda chain: chain.tokens.balance(token=token)) == 7
    refused(served.aira("liability", "claim", address), "nothing-owed", "was paid")


def test_anybody_claims_for_an_account_that_the_token_pays_again(served: ServedChain) -> None:
    token, person = blocking(served), served.people["person"].address
    address = served.create_liability(cost=7, token=token)
    served.mine(REFUND_DELAY)
    cancelled = served.run_json("liability", "cancel", address, "--refund", by="stranger")
    assert (cancelled["state"], cancelled["owed"]) == ("called-off", "7")
    assert served.run_json("liability", "show", address)["owed"] == "7"
    served.ask("person", lambda chain: block(chain, token, person, is_blocked=False))

    claimed = served.run_json("liability", "claim", address, by="stranger")

    assert claimed.pop("tx").startswith("0x")
    assert claimed.pop("gasUsed") > 21_000
    assert claimed == {"liability": address, "token": token, "account": person, "to": person, "claimed": "7"}
    assert "owed" not in served.run_json("liability", "show", address)
    assert served.ask("person", lambda chain: chain.tokens.balance(token=token)) == 1000


def test_a_refund_that_the_token_refused_says_what_is_owed(served: ServedChain) -> None:
    address = served.create_liability(cost=7, token=blocking(served))
    served.mine(REFUND_DELAY)
    said = columns(served.aira("liability", "cancel", address, "--refund", by="stranger").stdout)
    assert "paid back" not in said
    assert f"`aira liability claim {address}`" in said["owed"]


@pytest.mark.parametrize("command", ["show", "watch", "cancel", "claim"])
def test_an_address_without_a_liability_is_one_clear_line(served: ServedChain, command: str) -> None:
    refused(served.aira("liability", command, served.deployment.xrt), NotALiability, served.deployment.xrt)
    refused(served.aira("liability", command, "0x12"), InvalidAddress, "0x12")


def test_watching_a_finalized_liability_prints_it_at_once(served: ServedChain) -> None:
    address = served.create_liability()
    served.finalize(address)
    assert served.run_json("liability", "watch", address)["state"] == "paid"


@pytest.fixture
def watching(served: ServedChain) -> Iterator[Serving]:
    """`aira liability watch`, as another process."""
    with Serving(*AIRA, "liability", "watch", says="watching from block", variables=served.variables()) as server:
        yield server


def test_watching_all_prints_each_creation_and_finalization(served: ServedChain, watching: Serving) -> None:
    address = served.create_liability(cost=COST)
    watching.wait_until_said(f"{address}  created ")
    served.finalize(address)
    watching.wait_until_said(f"{address}  paid ")
    person = served.people["robot"].address
    assert f"{person[:6]}…{person[-4:]} for you, 1.5 XRT" in watching.log()
    code, _ = watching.end(signal.SIGINT)
    assert code == 130
    assert "Traceback" not in watching.log()


def test_watching_all_prints_what_a_reorganisation_reverts(served: ServedChain, watching: Serving) -> None:
    address = served.create_liability(cost=COST)
    watching.wait_until_said(f"{address}  created ")
    served.replace_blocks(1)
    watching.wait_until_said(f"a reorganisation reverted the creation of {address}")


def test_watching_all_waits_while_the_node_is_unreachable(served: ServedChain, watching: Serving) -> None:
    with served.unreachable():
        watching.wait_until_said("waiting for it")
    address = served.create_liability(cost=COST)
    watching.wait_until_said(f"{address}  created ")
    assert watching.log().count("waiting for it") == 1
    assert "Traceback" not in watching.log()


def test_watching_one_prints_it_when_it_is_finalized(served: ServedChain) -> None:
    address = served.create_liability(cost=COST)
    command = (*AIRA, "liability", "watch", address)
    with Serving(*command, says="waiting until it ends", variables=served.variables()) as watcher:
        served.finalize(address, success=False)
        watcher.wait_until_said("state       failed: ")


def test_watching_all_with_json_prints_one_object_per_line(served: ServedChain) -> None:
    block = served.ask("person", lambda chain: chain.block_number()) + 1
    address = served.create_liability()
    served.finalize(address)
    command = (*AIRA, "liability", "watch", "--json", "--from-block", str(block))
    with Serving(*command, says='"ended"', variables=served.variables()) as watcher:
        shown = [json.loads(line) for line in watcher.log().splitlines()]
    assert [(line["event"], line["liability"]["address"]) for line in shown] == [("made", address), ("ended", address)]


def test_ctrl_c_stops_watching_one(served: ServedChain) -> None:
    interrupted = Interrupted(
        "liability",
        "watch",
        served.create_liability(),
        at="waiting until it ends",
        after=0.2,
        variables=served.variables(),
    )
    assert (interrupted.code, interrupted.errors) == (130, "")


def test_a_separate_process_prints_the_same(served: ServedChain) -> None:
    done = aira("liability", "show", served.deployment.xrt, **served.variables())
    assert refused(done, NotALiability, served.deployment.xrt) == ""
