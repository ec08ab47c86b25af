"""How the processes of `make test` share the tests: a file at a time, the longest first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from xdist.workermanage import WorkerController  # type: ignore[import-untyped]

SECONDS: Final[dict[str, int]] = {
    "tests/web/test_page.py": 150,
    "tests/examples/test_blink.py": 120,
    "tests/mesh/cli/test_serving.py": 100,
    "tests/web/test_lessons.py": 90,
    "tests/web/test_outages.py": 90,
    "tests/bridges/ipfs/test_resilience.py": 80,
    "tests/web/test_lies.py": 75,
    "tests/mesh/operations/test_two_providers.py": 70,
    "tests/bridges/ipfs/test_channel.py": 55,
    "tests/contracts/test_money.py": 50,
    "tests/examples/test_air_pollution.py": 45,
    "tests/examples/test_greenhouse.py": 25,
    "tests/mesh/operations/test_unfit_at_the_start.py": 55,
    "tests/bridges/serial/test_firmware.py": 50,
    "tests/web/test_roles.py": 50,
    "tests/mesh/cli/test_chain_up.py": 50,
    "tests/mesh/cli/test_status.py": 35,
    "tests/mesh/cli/test_verify.py": 35,
    "tests/bridges/ipfs/test_content.py": 30,
    "tests/mesh/demo/test_demo.py": 30,
    "tests/bridges/ipfs/test_cli.py": 25,
    "tests/bridges/ipfs/test_jobs.py": 25,
    "tests/mesh/chain/test_following_reorganisations.py": 25,
}
"""Roughly how long the longest files take on a busy machine. All others are short."""


class LongestFirst(LoadFileScheduling):  # type: ignore[misc]
    """Gives each process whole files, so that fixtures of a module are set up once."""

    def remove_node(self, node: WorkerController) -> str | None:
        """Reassign what a crashed process left undone; returns the test that it crashed in, which is not run again."""
        workload = self.assigned_work[node]
        broken = next((test for unit in workload.values() for test, done in unit.items() if not done), None)
        for unit in workload.values():
            if broken in unit:
                unit[broken] = True
        self.assigned_work[node] = {name: unit for name, unit in workload.items() if not all(unit.values())}
        super().remove_node(node)
        return broken

    def _split_scope(self, nodeid: str) -> str:
        return nodeid.split("::", 1)[0]

    def _reschedule(self, node: WorkerController) -> None:
        # A process that just started may not have collected its tests yet.
        if node in self.registered_collections:
            super()._reschedule(node)

    def _assign_work_unit(self, node: WorkerController) -> None:
        longest = max(self.workqueue, key=lambda name: SECONDS.get(name, 0))
        self.workqueue.move_to_end(longest, last=False)
        super()._assign_work_unit(node)
