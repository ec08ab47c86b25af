"""How the processes of `make test` share the tests: a file or folder at a time, the longest first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from xdist.workermanage import WorkerController  # type: ignore[import-untyped]

TOGETHER: Final = ("tests/web", "tests/bridges/ipfs", "tests/bridges/ros1", "tests/contracts")
"""Folders whose files share servers: one process runs all of them, and its servers end with the last file."""

SECONDS: Final[dict[str, int]] = {
    "tests/web": 805,
    "tests/bridges/ipfs": 400,
    "tests/mesh/agent/test_jobs_behind_providers.py": 300,
    "tests/contracts": 220,
    "tests/examples/test_blink.py": 200,
    "tests/simulation/test_model.py": 100,
    "tests/mesh/recording/test_hostile.py": 145,
    "tests/simulation/test_simulation.py": 130,
    "tests/mesh/cli/test_serving.py": 125,
    "tests/mesh/cli/test_killed_validator.py": 120,
    "tests/mesh/cli/test_killed_demand.py": 100,
    "tests/bridges/ros1": 110,
    "tests/mesh/dev/test_demo.py": 90,
    "tests/mesh/cli/test_demand_validator.py": 90,
    "tests/peers/test_install.py": 40,
    "tests/bridges/serial/test_firmware.py": 50,
    "tests/mesh/cli/test_restarts.py": 75,
    "tests/mesh/validator/test_tampered_on_chain.py": 70,
    "tests/mesh/cli/test_two_providers.py": 70,
    "tests/simulation/test_markets.py": 70,
    "tests/mesh/market/test_provider_judgements.py": 65,
    "tests/examples/test_air_pollution.py": 65,
    "tests/bridges/web/test_beside.py": 65,
    "tests/mesh/chain/test_spoiled_answers.py": 65,
    "tests/mesh/cli/test_chain_up.py": 60,
    "tests/mesh/cli/test_unfit_at_the_start.py": 50,
    "tests/bridges/serial/test_unplugged.py": 50,
    "tests/mesh/content/test_names.py": 45,
    "tests/mesh/dev/test_narration.py": 45,
    "tests/mesh/validator/test_policies.py": 40,
    "tests/bridges/foxglove/test_foxglove_front.py": 40,
    "tests/examples/test_own_policy.py": 40,
    "tests/bridges/serial/test_dialect.py": 40,
    "tests/mesh/agent/test_spoiled_jobs.py": 35,
    "tests/mesh/validator/test_validator.py": 35,
    "tests/mesh/validator/test_juries.py": 35,
    "tests/mesh/agent/test_demand_floods.py": 30,
    "tests/mesh/cli/test_logs_of_roles.py": 30,
    "tests/packaging/test_wheel.py": 30,
    "tests/mesh/cli/test_replay.py": 30,
    "tests/mesh/validator/test_honest.py": 30,
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
