"""A chain with the contracts, served to commands, and accounts with keyfiles that run them."""

from __future__ import annotations

import asyncio
import json
import secrets
import threading
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

from click.testing import CliRunner
from eth_keyfile.keyfile import create_keyfile_json

from mesh.chain import XRT, Account, Chain, DeploymentPlan, Timing, deploy
from mesh.cli import main
from schemas import Demand, Offer, Result, cid_of_bytes
from schemas.address import ZERO_ADDRESS
from tests.support.development import serve_embedded

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator
    from pathlib import Path

    from click.testing import Result as Done

    from mesh.chain import Deployment

T = TypeVar("T")

PASSWORD: Final = "open sesame"
PEOPLE: Final = ("provider", "robot", "person", "stranger")
MONEY: Final = 1_000 * XRT
REFUND_DELAY: Final = 40
"""Blocks."""
TIMING: Final = Timing(poll_interval=0.05, receipt_interval=0.01)


@dataclass(frozen=True)
class Person:
    """An account, and its keyfile, which opens faster than real ones do."""

    account: Account
    keyfile: Path

    @property
    def address(self) -> str:
        return self.account.address


def write_quick_keyfile(path: Path, key: bytes, password: str = PASSWORD) -> Path:
    """A keyfile with a fast key derivation, for tests of other things."""
    path.write_text(json.dumps(create_keyfile_json(key, password.encode(), kdf="pbkdf2", iterations=1)))
    return path


class ServedChain:
    """A chain served by a thread of its own, and accounts with keyfiles: all but the stranger have XRT.

    `with ServedChain(folder) as served`. `is_deployed=False` leaves the chain without contracts.
    """

    def __init__(self, folder: Path, *, plan: DeploymentPlan | None = None, is_deployed: bool = True) -> None:
        self.folder = folder
        self._plan = plan or DeploymentPlan(refund_delay=REFUND_DELAY, timeout_blocks=5)
        self._is_deployed = is_deployed
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="served chain")
        self._stack = AsyncExitStack()
        self.people: dict[str, Person] = {}
        self.url = ""
        self.deployment: Deployment

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self.run(self._start())
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.run(self._stack.aclose())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the chain's thread; its result."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60)

    def chain(self, role: str) -> Chain:
        """The chain as one of the people uses it, not yet open."""
        return Chain(self._served.node.provider, account=self.people[role].account, timing=TIMING)

    def ask(self, role: str, question: Callable[[Chain], Coroutine[Any, Any, T]]) -> T:
        """Run `question` on the chain of one of the people; its answer."""

        async def asked() -> T:
            async with self.chain(role) as chain:
                return await question(chain)

        return self.run(asked())

    def mine(self, blocks: int = 1) -> None:
        """Mine empty blocks."""
        self.run(self._served.node.mine(blocks))

    def replace_blocks(self, count: int) -> None:
        """Reorganise the chain: its last blocks make room for one more of empty ones."""
        head = self.ask("provider", lambda chain: chain.block_number())
        self.run(self._served.node.request("evm_revert", [hex(head - count)]))
        self.mine(count + 1)

    @contextmanager
    def unreachable(self) -> Iterator[None]:
        """The chain does not answer meanwhile."""
        self.run(self._served.server.__aexit__(None, None, None))
        try:
            yield
        finally:
            self.run(self._served.server.__aenter__())

    def variables(self, role: str = "person", **changes: str) -> dict[str, str]:
        """The settings of one of the people, as environment variables."""
        password = self.folder / "password"
        return {
            "AIRA_WEB3_HTTP_PROVIDER": self.url,
            "AIRA_KEYFILE": str(self.people[role].keyfile),
            "AIRA_KEYFILE_PASSWORD_FILE": str(password),
            "AIRA_DATA_DIR": str(self.folder / "state"),
            "AIRA_POLL_INTERVAL": "0.05",
            "AIRA_GENERATION": "3",
        } | changes

    def aira(self, *arguments: str | Path, by: str = "person", **changes: str) -> Done:
        """Run a command in this process, as one of the people; `changes` of the variables."""
        return CliRunner().invoke(main, [str(word) for word in arguments], env=self.variables(by, **changes))

    def run_json(self, *arguments: str | Path, by: str = "person", **changes: str) -> Any:
        """Run a command with `--json`, which must succeed; what it prints."""
        done = self.aira(*arguments, "--json", by=by, **changes)
        said = [line for line in done.stderr.splitlines() if not line.startswith("waiting until the transaction")]
        assert (done.exit_code, said) == (0, []), done.output
        assert done.stdout.count("\n") == 1
        return json.loads(done.stdout)

    def create_liability(self, *, cost: int = 0, token: str = "", **fees: int) -> str:
        """Create a liability of the person (promisee) and the robot (promisor); its address."""
        terms: dict[str, Any] = {
            "model": cid_of_bytes(b"a model"),
            "objective": cid_of_bytes(b"an objective"),
            "token": token or self.deployment.xrt,
            "cost": cost,
            "lighthouse": self.deployment.lighthouse,
            "validator": ZERO_ADDRESS,
            "deadline": 1_000_000,
        }
        demand = Demand(**terms, nonce=secrets.token_hex(32), validator_fee=0)
        offer = Offer(**terms, nonce=secrets.token_hex(32), lighthouse_fee=fees.get("lighthouse_fee", 0))
        signed = self.people["person"].account.signer.sign(demand), self.people["robot"].account.signer.sign(offer)
        lighthouse = self.deployment.lighthouse
        return self.ask("provider", lambda chain: chain.liabilities.create(lighthouse, *signed)).liability

    def finalize(self, liability: str, *, success: bool = True) -> str:
        """Finalize a liability with a result of the robot; its CID."""
        cid = cid_of_bytes(b"a recording")
        result = Result(liability=liability, result=cid, success=success)
        signed = self.people["robot"].account.signer.sign(result)
        self.ask("provider", lambda chain: chain.liabilities.finalize(self.deployment.lighthouse, signed))
        return cid

    async def _start(self) -> None:
        self._served = await self._stack.enter_async_context(serve_embedded(port=0))
        self.url = self._served.url
        (self.folder / "password").write_text(PASSWORD + "\n")
        for role, key in zip(PEOPLE, self._served.node.funded_keys, strict=False):
            keyfile = await asyncio.to_thread(write_quick_keyfile, self.folder / f"{role}.json", key)
            self.people[role] = Person(Account(key), keyfile)
        if self._is_deployed:
            provider = self.people["provider"].account
            self.deployment = await deploy(self._served.node.provider, provider, plan=self._plan)
            await self._fund()

    async def _fund(self) -> None:
        lighthouse = self.deployment.lighthouse
        async with self.chain("provider") as chain:
            for role in ("robot", "person"):
                await chain.tokens.transfer(self.people[role].address, MONEY)
            await chain.tokens.approve(lighthouse, 100 * XRT)
            await chain.lighthouses.refill(lighthouse, 100 * XRT)
        for role in ("robot", "person"):
            async with self.chain(role) as chain:
                await chain.tokens.approve(chain.factory, MONEY)


def columns(text: str) -> dict[str, str]:
    """The facts printed in two columns, by their names."""
    pairs = (line.split("  ", 1) for line in text.splitlines() if "  " in line)
    return {name.strip(): value.strip() for name, value in pairs}
