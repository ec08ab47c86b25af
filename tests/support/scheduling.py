"""How the processes of `make test` share the tests: a file or folder at a time, the longest first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from xdist.workermanage import WorkerController  # type: ignore[import-untyped]

TOGETHER: Final = ("tests/web", "tests/bridges/ipfs", "tests/bridges/ros1", "tests/contracts")
"""Folders whose files share servers: one process runs all of them, and its servers end with the last file."""

SECONDS: Final[dict[str, int]] = {
    "tests/web": 1170,
    "tests/bridges/ipfs": 500,
    "tests/mesh/recording/test_hostile.py": 280,
    "tests/mesh/cli/test_rotation.py": 240,
    "tests/test_readmes.py": 230,
    "tests/contracts": 200,
    "tests/bridges/ros1": 190,
    "tests/mesh/agent/test_jobs_behind_providers.py": 180,
    "tests/simulation/test_simulation.py": 130,
    "tests/mesh/chain/test_spoiled_answers.py": 110,
    "tests/mesh/agent/test_due_refunds.py": 110,
    "tests/mesh/cli/test_choosing.py": 110,
    "tests/test_tutorials.py": 110,
    "tests/mesh/cli/test_killed_demand.py": 110,
    "tests/mesh/cli/test_killed_validator.py": 110,
    "tests/bridges/serial/test_dialect.py": 110,
    "tests/mesh/dev/test_demo.py": 110,
    "tests/examples/test_blink.py": 100,
    "tests/bridges/mcp/test_mcp_kills.py": 100,
    "tests/mesh/cli/test_demand_validator.py": 100,
    "tests/mesh/cli/test_two_tokens.py": 100,
    "tests/mesh/cli/test_stop_and_hand_back.py": 100,
    "tests/bridges/mcp/test_mcp_consents.py": 100,
    "tests/bridges/mcp/test_mcp_jobs.py": 95,
    "tests/mesh/cli/test_second_chances.py": 95,
    "tests/mesh/cli/test_serving.py": 90,
    "tests/bridges/serial/test_firmware.py": 90,
    "tests/mesh/signer/test_kills.py": 90,
    "tests/mesh/cli/test_geth.py": 90,
    "tests/simulation/test_markets.py": 85,
    "tests/mesh/cli/test_new.py": 85,
    "tests/mesh/validator/test_limits.py": 85,
    "tests/crashes/test_permits.py": 80,
    "tests/mesh/cli/test_restarts.py": 80,
    "tests/bridges/serial/test_unplugged.py": 65,
    "tests/bridges/a2a/test_jobs.py": 65,
    "tests/mesh/cli/test_unfit_at_the_start.py": 60,
    "tests/mesh/content/test_names.py": 55,
    "tests/mesh/validator/test_validator.py": 55,
    "tests/examples/test_air_pollution.py": 50,
    "tests/mesh/validator/test_juries.py": 50,
    "tests/mesh/validator/test_tampered_on_chain.py": 50,
    "tests/mesh/cli/test_two_providers.py": 50,
    "tests/mesh/testing/test_market.py": 50,
    "tests/mesh/cli/test_permits.py": 50,
    "tests/mesh/cli/test_owners_page.py": 50,
}
"""Roughly how long the longest files and folders take in CI. All others are short."""


class LongestFirst(LoadFileScheduling):  # type: ignore[misc]
    """Gives each process whole files, so that fixtures of a module are set up once, and the folders in `TOGETHER`."""

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
        file = nodeid.split("::", 1)[0]
        return next((folder for folder in TOGETHER if file.startswith(f"{folder}/")), file)

    def _reschedule(self, node: WorkerController) -> None:
        # A process that just started may not have collected its tests yet.
        if node in self.registered_collections:
            super()._reschedule(node)

    def _assign_work_unit(self, node: WorkerController) -> None:
        longest = max(self.workqueue, key=lambda name: SECONDS.get(name, 0))
        self.workqueue.move_to_end(longest, last=False)
        super()._assign_work_unit(node)
