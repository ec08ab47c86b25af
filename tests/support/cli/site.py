"""A market in operation: a chain behind a URL, a router, and processes with keyfiles and state of their own."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.agent import Agent
from mesh.base.retry import RetryPolicy
from mesh.chain import XRT, Account, Chain
from mesh.dev.development import ALLOWANCE, PLAN, ROLES, deploy_market
from mesh.role.composition import chain_of
from mesh.settings import Settings
from schemas import cid_of_bytes
from tests.support.cli.served_chain import write_quick_keyfile
from tests.support.commands import AIRA, Serving
from tests.support.objectives import objective

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from mesh.chain import DeploymentPlan, NewLighthouse
    from schemas import Demand, Verified

MODEL: Final = cid_of_bytes(b"what the robots of the operated market can do")
PEOPLE: Final = (*ROLES, "rival", "poor", "validator")
"""The roles with an account; `rival`, `poor` and `validator` have ETH only."""
FEE: Final = 5
"""The lighthouse fee of the robot's offers, wn."""
PASSWORD: Final = "only for tests"
GENERATION_5: Final = {
    "generation": "5",
    "factory_contract": "factory.3.robonomics.eth",
    "xrt_contract": "xrt.3.robonomics.eth",
    "erc20_token": "xrt.3.robonomics.eth",
}
"""Settings of a process that trades in generation 5, with the contracts for which the allowances are approved."""
QUICK_RESEND: Final = RetryPolicy(initial=0.3, ceiling=1.0)


class Site:
    """`await Site.found(url, keys, endpoint, folder)` with the addresses of the chain's node and the router."""

    def __init__(self, url: str, keys: Sequence[bytes], endpoint: str, folder: Path) -> None:
        self.url = url
        self.endpoint = endpoint
        self.folder = folder
        self.keys = dict(zip(PEOPLE, keys, strict=False))
        self.accounts = {role: Account(key) for role, key in self.keys.items()}
        self.lighthouse = Settings().lighthouse_contract

    @classmethod
    async def found(
        cls, url: str, keys: Sequence[bytes], endpoint: str, folder: Path, *, plan: DeploymentPlan = PLAN
    ) -> Site:
        """Deploy a market, and approve the allowances of robot and person."""
        await deploy_market(url, keys, plan=plan)
        site = cls(url, keys, endpoint, folder)
        for role in ("robot", "person"):
            async with site.chain(role) as chain:
                await chain.tokens.approve(chain.factory, ALLOWANCE)
        return site

    def address(self, role: str) -> str:
        return self.accounts[role].address

    def settings(self, role: str, **options: Any) -> Settings:
        """An agent's settings. Objectives are played at once."""
        fields: dict[str, Any] = {
            "connect": (self.endpoint,),
            "data_dir": str(self.folder / "state"),
            "web3_http_provider": self.url,
            "lighthouse_contract": self.lighthouse,
            "poll_interval": 0.05,
            "answer_timeout": 60.0,
            "playback": "at-once",
        }
        return Settings(**(fields | options))

    def chain(self, role: str) -> Chain:
        """The chain for an account, not yet open."""
        return chain_of(self.settings(role), self.accounts[role])

    def agent(self, role: str, **options: Any) -> Agent:
        """An agent of that role, not yet running; always with the same state folder."""
        settings, account = self.settings(role, **options), self.accounts[role]
        return Agent(MODEL, settings=settings, account=account, resend=QUICK_RESEND)

    def variables(self, role: str, **options: str) -> dict[str, str]:
        """The settings of a process of that role. The first call writes its keyfile."""
        keyfile, password = self.folder / f"{role}.json", self.folder / "password"
        if not keyfile.exists():
            password.write_text(PASSWORD + "\n")
            write_quick_keyfile(keyfile, self.keys[role], PASSWORD)
        fields = {
            "connect": self.endpoint,
            "data_dir": str(self.folder / "state"),
            "web3_http_provider": self.url,
            "lighthouse_contract": self.lighthouse,
            "poll_interval": "0.05",
            "answer_timeout": "60",
            "keyfile": str(keyfile),
            "keyfile_password_file": str(password),
        }
        return {f"AIRA_{name.upper()}": value for name, value in (fields | options).items()}

    def provider(self, role: str = "provider", **options: str) -> Serving:
        """`aira provider` as a process that logs in JSON, not yet started; with these settings."""
        variables = self.variables(role, log_format="json", **options)
        return Serving(*AIRA, "provider", says='"provider-started"', variables=variables)

    async def found_lighthouse(self, name: str, *, timeout_blocks: int, **quotas: int) -> NewLighthouse:
        """Create a lighthouse with these quotas of transactions per turn, and trade there from now on."""
        async with self.chain("provider") as chain:
            made = await chain.lighthouses.create(minimal_stake=XRT, timeout_blocks=timeout_blocks, name=name)
            for role, quota in quotas.items():
                await chain.tokens.transfer(self.address(role), quota * XRT)
        for role, quota in quotas.items():
            async with self.chain(role) as chain:
                await chain.lighthouses.become_provider(made.lighthouse, quota * XRT)
        self.lighthouse = f"{name}.lighthouse.3.robonomics.eth"
        return made

    def robot(self, done: list[str], **options: Any) -> Agent:
        """A robot that offers to do every demand, and adds the words of objectives to `done`."""
        robot = self.agent("robot", **options)

        @robot.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            await robot.offer(demand, lighthouse_fee=FEE)

        @robot.on("/say")
        async def say(job: object, message: Any) -> None:
            done.append(message.data)

        return robot

    def job(self, word: str) -> Path:
        """An objective with one message, a word."""
        path = self.folder / f"{word}.mcap"
        path.write_bytes(objective(("/say", word)))
        return path


def events(log: str) -> list[dict[str, Any]]:
    """The events in a log of JSON lines, of which the last may be half written."""
    lines = log[: log.rfind("\n") + 1].splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


def has_event(server: Serving, name: str, **facts: str) -> bool:
    """Whether a process that logs in JSON has logged an event of that name with these facts."""
    wanted = {"event": name, **facts}.items()
    return any(wanted <= event.items() for event in events(server.log()))


def has_traceback(server: Serving) -> bool:
    """Whether a process that logs in JSON has logged or printed a traceback."""
    return "Traceback" in server.log()


def settings_of(site: Site, role: str) -> Settings:
    """A role's settings, with its keyfile."""
    variables = site.variables(role)
    keyfile, password = variables["AIRA_KEYFILE"], variables["AIRA_KEYFILE_PASSWORD_FILE"]
    return site.settings(role, keyfile=keyfile, keyfile_password_file=password)
