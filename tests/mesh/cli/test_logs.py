"""`aira logs`: what it prints of an answer, which peer it asks, and how it ends."""

from __future__ import annotations

import json
import signal
import subprocess
from typing import TYPE_CHECKING, Any

import pytest
import zenoh

from mesh.network import ServiceFailed
from mesh.ops.identity import Member
from schemas import RpcKey
from schemas.status import LogsRead
from tests.support.cli.following import Follower, answer, event, pretender
from tests.support.commands import AIRA, SECONDS, environment, invoke, refused
from tests.support.orders import PERSON, ROBOT, STRANGER
from tests.support.routers import EmbeddedRouter, client_config, wait_until_declared
from tests.support.sites import Site
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.identity.roster import Role
    from schemas import Signer


def test_following_continues_after_a_restart_of_the_router(router: EmbeddedRouter) -> None:
    with (
        pretender(router.endpoint, event("hello")),
        Follower(ROBOT.address, endpoint=router.endpoint) as follower,
    ):
        follower.until("hello")
        router.stop()
        follower.until("aira: no answer; waiting")
        router.start()
        follower.until("aira: answering again")
        follower.until("hello", once_more=True)
        assert follower.interrupt() == 130


def test_control_characters_of_a_hostile_agent_are_not_printed(router: EmbeddedRouter) -> None:
    wild = "\x1b[2J\x9b\r\u202e\x7f\x00\n"
    hostile = event(wild, time=wild, level=wild, logger=wild, liability=wild, error=wild, trace=f"a{wild}b{wild}")
    with pretender(router.endpoint, hostile):
        for options in ((), ("--json",)):
            done = invoke("logs", ROBOT.address, *options, AIRA_CONNECT=router.endpoint)
            assert done.returncode == 0
            assert all(line.isprintable() for line in done.stdout.split("\n")), ascii(done.stdout)
            assert done.stdout.count("\n") == (1 if options else 5), done.stdout
        assert json.loads(done.stdout)["message"] == wild
        with Follower(ROBOT.address, endpoint=router.endpoint) as follower:
            assert "\x1b" not in follower.until("    | ")


def test_missed_events_are_reported(router: EmbeddedRouter) -> None:
    with (
        pretender(router.endpoint, event("hello"), missed=1_234),
        Follower(ROBOT.address, endpoint=router.endpoint) as follower,
    ):
        follower.until("aira: missed 1,234 events")


def test_an_unreadable_answer_is_one_clear_line(router: EmbeddedRouter) -> None:
    key = str(RpcKey(ROBOT.address, "logs"))
    with zenoh.open(client_config(router.endpoint)) as session:
        queryable: Any = session.declare_queryable(key, lambda query: answer(query, key, b"\x1b[2J"))
        wait_until_declared(router.endpoint, key, answers=True)
        done = invoke("logs", ROBOT.address, AIRA_CONNECT=router.endpoint)
        queryable.undeclare()
    refused(done, ServiceFailed)
    assert done.stderr.strip().isprintable()


@pytest.mark.parametrize("options", [(), ("--follow",), ("--device", "board")])
def test_a_missing_agent_is_one_clear_line(router: EmbeddedRouter, options: tuple[str, ...]) -> None:
    done = invoke("logs", ROBOT.address, *options, AIRA_CONNECT=router.endpoint)
    who = f"the device board of {ROBOT.address}" if "--device" in options else ROBOT.address
    assert refused(done, "no-answer", f"{who} does not answer").startswith("`aira peers` shows who is present")


def test_ctrl_c_stops_waiting_for_an_answer(router: EmbeddedRouter) -> None:
    """An agent that never answers."""
    queries: list[zenoh.Query] = []
    with zenoh.open(client_config(router.endpoint)) as session:
        queryable: Any = session.declare_queryable(str(RpcKey(ROBOT.address, "logs")), queries.append)
        command = ["logs", ROBOT.address, "--timeout", "60"]
        with subprocess.Popen(
            [*AIRA, *command], env=environment({"AIRA_CONNECT": router.endpoint}), stderr=subprocess.PIPE
        ) as asking:
            wait_until(lambda: queries, what="the question")
            asking.send_signal(signal.SIGINT)
            assert asking.wait(SECONDS) == 130
            assert asking.stderr is not None
            assert asking.stderr.read() == b""
        queryable.undeclare()
        queries.clear()


def test_on_a_closed_site_an_operator_can_read_logs_and_an_agent_can_not(tmp_path: Path) -> None:
    site = Site(tmp_path)
    people: dict[str, tuple[Signer, Role]] = {
        "robot": (ROBOT, "agent"),
        "person": (PERSON, "agent"),
        "chief": (STRANGER, "operator"),
    }
    folders = {
        name: site.enlist(Member(name=name, address=signer.address.lower(), roles=(role,)))
        for name, (signer, role) in people.items()
    }

    def credentials(name: str) -> dict[str, str]:
        own = folders[name]
        return {
            "AIRA_CONNECT": site.endpoint,
            "AIRA_TLS_CA": str(own.ca),
            "AIRA_TLS_CERTIFICATE": str(own.certificate),
            "AIRA_TLS_KEY": str(own.key),
        }

    key = str(RpcKey(ROBOT.address, "logs"))
    reply = LogsRead(instance="one", began="", entries=(event("a word of the site"),), last=1).encode()
    with site.open_router("wheel"), zenoh.open(site.client(folders["robot"]).config()) as session:
        queryable: Any = session.declare_queryable(key, lambda query: answer(query, key, reply))
        with zenoh.open(site.client(folders["chief"]).config()) as other, other.declare_querier(key) as querier:
            wait_until(lambda: querier.matching_status.matching, what="the queryable")  # type: ignore[attr-defined]
        seen = invoke("logs", ROBOT.address, **credentials("chief"))
        assert (seen.returncode, "a word of the site" in seen.stdout) == (0, True), seen.stderr
        hidden = invoke("logs", ROBOT.address, **credentials("person"))
        assert (hidden.returncode, hidden.stdout) == (1, "")
        queryable.undeclare()
