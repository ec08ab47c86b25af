"""What owners and operators see: models of robots that wait, jobs by phase, alerts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bridges.web._views import VIEW_LIMITS, alerts_of
from mesh import Job, String  # noqa: TC001  handlers are read at run time
from schemas.status import Status, StoreUse, Work
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from tests.support.market import Place

DATA = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
ROBOT = "0x70997970C51812dc3A010C7d01b50e0d17dc79C8"


async def test_a_robot_that_waits_for_demands_shows_its_model(place: Place, serve: Any) -> None:
    async with offering(place.agent("robot")), serve() as browser:

        async def answering() -> list[Any]:
            return [agent for agent in (await browser.get("agents"))["agents"] if agent["status"]]

        (robot,) = await until_found(answering, what="the robot's answer")
        assert (robot["offers"], robot["models"]) == ([], [MODEL])
        assert robot["status"]["model"] == MODEL


async def test_the_program_of_a_person_who_orders_is_no_robot(place: Place, serve: Any) -> None:
    async with place.agent("person"), serve() as browser:

        async def answering() -> list[Any]:
            return [agent for agent in (await browser.get("agents"))["agents"] if agent["status"]]

        (person,) = await until_found(answering, what="the person's answer")
        assert (person["profile"], person["models"]) == (None, [])


async def test_jobs_are_counted_by_phase(place: Place, serve: Any) -> None:
    robot = offering(place.agent("robot"))

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        pass

    async with place.provider(), robot, serve("person") as browser:
        made = await browser.post("objectives", objective(("/blink", "a job of its own")), headers=DATA)
        await browser.post("local/orders", {"model": MODEL, "objective": made["cid"], "cost": "7"}, status=202)
        party = place.address("person")

        async def newest() -> Any:
            """The newest job, once it has ended."""
            jobs = await browser.get("liabilities", party=party, phase="finalized", limit=1)
            found = jobs["liabilities"]
            return jobs if found and found[0]["objective"] == made["cid"] else None

        await until_found(newest, what="the job's end")
        jobs = await newest()
        ended = await browser.get("liabilities", party=party, phase="finalized", limit=500)
        assert jobs["phases"]["finalized"] == len(ended["liabilities"]) >= 1
        running = await browser.get("liabilities", party=party, phase="running", limit=500)
        assert made["cid"] not in {job["objective"] for job in running["liabilities"]}


def status(**facts: Any) -> Status:
    about: dict[str, Any] = {
        "role": "agent",
        "address": ROBOT,
        "version": "1",
        "zenoh_id": "1",
        "lighthouse": "l",
        "chain_id": 1,
    }
    return Status(**(about | {"parts": {"channel": "alive", "executor": "off"}, "head": 1000} | facts))


def test_what_does_not_work_is_an_alert() -> None:
    full = Work(jobs={}, outbox=0, store=StoreUse(files=1, bytes=99, quota=100))
    cases: dict[str, Any] = {
        "silent": None,
        "part-waits": status(parts={"listener": "waits for the node"}),
        "behind": status(head=900),
        "store-full": status(work=full),
        "drops": status(heaviest={"rate": {"0x00": 40, "0x01": 2}}),
    }
    for code, found in cases.items():
        (alert,) = alerts_of({ROBOT: found}, 1000)
        assert (alert["agent"], alert["code"]) == (ROBOT, code)
    assert alerts_of({ROBOT: status()}, 1000) == []
    endless = {str(number): status(parts={"part": "x" * 10_000}) for number in range(2 * VIEW_LIMITS.alerts)}
    bounded = alerts_of(endless, 1000)
    assert len(bounded) == VIEW_LIMITS.alerts
    assert max(len(alert["detail"]) for alert in bounded) == VIEW_LIMITS.detail
