"""`aira rpc`: services called from the command line; arguments are checked before the call."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.cli import main
from mesh.cli.rpc import command, request_of
from mesh.errors import InputError
from mesh.network import Endpoints, Network, ServiceFailed
from schemas import RpcKey
from schemas.rpc import GUARDED, SERVICES, FinishLiability, LiabilityRequest, Nothing, SendDemand, TransferRequest
from tests.support.cli.served_chain import columns
from tests.support.commands import coroutine
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.orders import LIGHTHOUSE, STRANGER, demand
from tests.support.raising import raises_with
from tests.support.waiting import until_answered, until_found

if TYPE_CHECKING:
    from tests.support.market import Place

MOST = 2**256 - 1


def test_arguments_are_given_by_name() -> None:
    assert request_of("start", [f"address={LIGHTHOUSE}"]) == LiabilityRequest(LIGHTHOUSE)
    assert request_of("finish", [f"address={LIGHTHOUSE}", "success=yes"]) == FinishLiability(LIGHTHOUSE, True)
    assert request_of("finish", ["success=FALSE", "address=a=b"]) == FinishLiability("a=b", False)
    assert request_of("eth/transfer", ["to=x", f"value={MOST}"]) == TransferRequest("x", MOST)
    assert request_of("eth/accounts", []) == Nothing()


def test_arguments_are_given_as_one_json_object() -> None:
    assert request_of("read", [json.dumps({"address": LIGHTHOUSE})]) == LiabilityRequest(LIGHTHOUSE)
    for value in (5, "5"):
        assert request_of("eth/transfer", [json.dumps({"to": "x", "value": value})]) == TransferRequest("x", 5)
    assert request_of("eth/accounts", ["{}"]) == Nothing()


def test_a_signed_demand_is_sent_as_it_is() -> None:
    request = SendDemand.of(demand())
    assert request_of("send/demand", [request.encode().decode()]) == request
    values = json.loads(request.encode())
    assert request_of("send/demand", [f"{name}={value}" for name, value in values.items()]) == request


@pytest.mark.parametrize(
    ("service", "arguments", "value", "hint"),
    [
        ("start", [], "address", "start takes address"),
        ("eth/transfer", ["to=x"], "value", "eth/transfer takes to, value"),
        ("read", ["adress=x"], "'adress'", "did you mean address? read takes address"),
        ("eth/accounts", ["x=y"], "'x'", "eth/accounts takes no arguments"),
        ("read", ["address"], "'address'", "write name=value, or one JSON object"),
        ("read", ["address=x", "address=y"], "address", ""),
        ("read", ['{"address":'], "not JSON: Input data was truncated", ""),
        ("read", ['{"address":5}'], "read: address is '5'", ""),
        ("finish", ["address=x", "success=maybe"], "finish: success is 'maybe'", ""),
        ("finish", ['{"address":"x","success":1}'], "finish: success is '1'", ""),
        *(
            ("eth/transfer", ["to=x", f"value={value}"], f"eth/transfer: value is '{value}'", "")
            for value in ("1.5", "-1", "", "1e9", "٣")
        ),
    ],
)
def test_invalid_arguments_are_one_clear_line(service: str, arguments: list[str], value: str, hint: str) -> None:
    with raises_with(InputError, code="invalid-argument") as caught:
        request_of(service, arguments)
    assert value in str(caught.value)
    assert caught.value.hint == hint


def test_a_number_beyond_256_bits_is_refused() -> None:
    for value in (str(MOST + 1), "9" * 5000):
        with pytest.raises(InputError, match=r"^eth/transfer: "):
            request_of("eth/transfer", ["to=x", f"value={value}"])


def test_the_list_has_every_service_with_its_arguments() -> None:
    head, *rows = CliRunner().invoke(main, ["rpc", "--list"]).stdout.splitlines()
    assert head.split() == ["service", "arguments", "answer"]
    assert [row.split()[0] for row in rows] == [name + "*" * (name in GUARDED) for name in SERVICES]
    assert next(row for row in rows if row.startswith("finish")).split()[1:] == ["address", "success", "none"]
    listed = json.loads(CliRunner().invoke(main, ["rpc", "--list", "--json"]).stdout)
    assert listed["eth/approve"] == {"arguments": ["spender", "value"], "answer": ["txhash"], "guarded": True}
    assert listed.keys() == SERVICES.keys()


async def ask(place: Place, service: str, *arguments: str, as_json: bool = False) -> None:
    """Call a service of the robot without an account, once it can be called."""
    async with Network(Endpoints(connect=(place.endpoint,))) as network:
        await until_answered(network.session, str(RpcKey(place.address("robot"), service)))
    called = place.settings("watcher"), place.address("robot"), service, arguments
    await coroutine(command)(*called, as_list=False, timeout=60.0, as_json=as_json)


async def test_a_reply_is_printed_as_columns_or_json(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.agent("robot"):
        await ask(place, "eth/accounts")
        assert capsys.readouterr().out == f"accounts  {place.address('robot')}\n"
        await ask(place, "eth/xrt_balance", as_json=True)
        assert json.loads(capsys.readouterr().out) == {"balance": str(await place.balance("robot"))}
        await ask(place, "eth/account_eth_balance", f"account={LIGHTHOUSE}")
        assert capsys.readouterr().out == "balance  0 ETH\n"
        await ask(place, "status")
        assert columns(capsys.readouterr().out)["executor"] == "alive"


async def test_a_job_is_driven_from_the_command_line(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.at_work(offering(place.agent("robot"))) as person:
        contract = await person.demand(place.save(objective(("/go", "x"))), cost=1)

        async def started() -> bool:
            try:
                await ask(place, "start", f"address={contract.address}")
            except ServiceFailed:
                return False
            return True

        await until_found(started, what="the job's start", seconds=30)
        assert columns(capsys.readouterr().out)["success"] == "yes"
        await ask(place, "finish", f"address={contract.address}", "success=true")
        assert columns(capsys.readouterr().out)["finish"] == "done"
        assert (await contract.outcome()).success
        await ask(place, "read", f"address={contract.address}")
        shown = columns(capsys.readouterr().out)
        assert (shown["read"], shown["address"], shown["isSuccess"]) == ("yes", contract.address, "yes")


async def test_a_failed_service_call_is_an_error(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    async with place.agent("robot"):
        with pytest.raises(ServiceFailed) as start:
            await ask(place, "start", f"address={LIGHTHOUSE}")
        assert (start.value.service, start.value.reason) == ("start", "agent-error")
        assert LIGHTHOUSE in str(start.value)
        with raises_with(InputError, code="unknown-job", match=LIGHTHOUSE):
            await ask(place, "read", f"address={LIGHTHOUSE}")
        with pytest.raises(ServiceFailed) as approve:
            await ask(place, "eth/approve", f"spender={LIGHTHOUSE}", "value=1")
        assert (approve.value.service, approve.value.reason) == ("eth/approve", "agent-error")
        assert "does not offer eth/approve" in str(approve.value)
        assert capsys.readouterr().out == ""
        with pytest.raises(ServiceFailed):
            await ask(place, "start", f"address={LIGHTHOUSE}", as_json=True)
        assert json.loads(capsys.readouterr().out)["success"] is False


async def test_a_missing_agent_is_an_error(place: Place) -> None:
    """The same one as of `aira status` and `aira logs`."""
    with raises_with(ServiceFailed, code="no-answer") as caught:
        await coroutine(command)(
            place.settings("watcher"), STRANGER.address, "eth/accounts", (), as_list=False, timeout=2.0, as_json=False
        )
    assert (caught.value.service, caught.value.reason, caught.value.code) == ("eth/accounts", "no-agent", "no-answer")
    assert str(caught.value) == f"{STRANGER.address} does not answer"
