"""A market with a robot, and the page's server, each role in its own process; once for all tests of this folder."""

from __future__ import annotations

import json
import os
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from eth_account import Account

from schemas import cid_of_file
from schemas.model import parse_description
from tests.support.commands import AIRA, Serving, aira
from tests.support.ports import free_port
from tests.support.web.browser import Browser, Wallet
from tests.support.web.steps import order

if TYPE_CHECKING:
    from collections.abc import Iterator

HERE = Path(__file__).parent
HOSTILE = '<img src=x onerror="document.title=1">\u202e\u0007<script>document.title = "hacked"</script>'


@dataclass(frozen=True)
class Site:
    """What the tests use."""

    url: str
    model: str
    hostile_model: str
    node: str
    person: bytes
    variables: dict[str, str]
    folder: Path

    def wallet(self) -> Wallet:
        """A wallet with the person's key."""
        return Wallet(self.person, self.node)

    def poor_wallet(self) -> Wallet:
        """A wallet with a key that nobody has given anything."""
        return Wallet(os.urandom(32), self.node)

    @contextmanager
    def page(self, *options: str, keyfile: bool = False, port: int = 0) -> Iterator[str]:
        """Another server of the page; gives its address."""
        port = port or free_port()
        with self.page_server(*options, keyfile=keyfile, port=port):
            yield f"http://127.0.0.1:{port}"

    def page_server(self, *options: str, keyfile: bool = False, port: int) -> Serving:
        """The process of another server of the page, not yet running."""
        variables = dict(self.variables) | {"AIRA_DATA_DIR": str(self.folder / f"web-{port}")}
        if keyfile:
            variables["AIRA_KEYFILE"] = f"{self.folder}/development/person.json"
        command = ("web", "--listen", f"127.0.0.1:{port}", *options)
        return Serving(*AIRA, *command, says="page  ", variables=variables)

    @contextmanager
    def validator(self, *options: str, role: str = "provider") -> Iterator[None]:
        """A validator at work, with the account of a role, which has ether."""
        keyfile = f"{self.folder}/development/{role}.json"
        variables = self.variables | {"AIRA_KEYFILE": keyfile, "AIRA_DATA_DIR": str(self.folder / f"judge-{role}")}
        with Serving(*AIRA, "validator", *options, says=" judges by ", variables=variables):
            yield


def hostile_model(folder: Path) -> Path:
    """A model whose texts are scripts."""
    model = json.loads((HERE / "model.json").read_text())
    script = '<img src=x onerror="document.title=1"><script>document.title=1</script>'
    model |= {"title": script, "description": script, "success": script}
    (topic,) = model["objective"]
    topic["title"] = topic["value"]["properties"]["direction"]["title"] = script
    path = folder / "hostile.json"
    path.write_bytes(parse_description(json.dumps(model).encode()).encode())
    return path


@contextmanager
def opened(folder: Path, *options: str) -> Iterator[Site]:
    """A market that `aira up` makes with these options, with the robot and a page."""
    port = free_port()
    endpoint, node = f"tcp/127.0.0.1:{free_port()}", f"http://127.0.0.1:{port}"
    variables = {
        "AIRA_CONNECT": endpoint,
        "AIRA_WEB3_HTTP_PROVIDER": node,
        "AIRA_DATA_DIR": str(folder),
        "AIRA_KEYFILE_PASSWORD_FILE": str(folder / "development" / "password"),
    }
    with ExitStack() as stack:
        up = ("up", "--no-web", "--data-dir", str(folder), "--listen", endpoint, "--port", str(port), *options)
        stack.enter_context(Serving(*AIRA, *up, says="provider    0x"))
        model = json.loads(aira("model", "new", HERE / "model.json", "--out", folder / "model.json", "--json").stdout)
        hostile = hostile_model(folder)
        robot = (sys.executable, HERE / "robot.py", folder / "model.json", HOSTILE, hostile)
        keyfile = variables | {"AIRA_KEYFILE": f"{folder}/development/robot.json", "AIRA_OPEN_SERVICES": "true"}
        stack.enter_context(Serving(*robot, says="robot 0x", variables=keyfile))
        password = (folder / "development" / "password").read_text().strip()
        key = Account.decrypt((folder / "development" / "person.json").read_text(), password)
        models = model["cid"], cid_of_file(hostile)
        site = Site("", *models, node, bytes(key), variables, folder)
        url = stack.enter_context(site.page())
        yield Site(url, *models, node, bytes(key), variables, folder)


@pytest.fixture(scope="package")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with opened(tmp_path_factory.mktemp("site")) as site:
        yield site


@pytest.fixture(scope="package")
def paid_job(site: Site) -> str:
    """The address of a job that is paid, with all checks passed."""
    with Browser(site.url, site.wallet()) as browser:
        address = order(browser, site)
        browser.sees("the robot was paid")
        browser.until(lambda: len(browser.all(".findings .badge.good")) >= 19, "all checks")
        return address


@pytest.fixture
def browser(site: Site) -> Iterator[Browser]:
    """A browser with the person's wallet."""
    with Browser(site.url, site.wallet()) as browser:
        yield browser


@pytest.fixture
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where screenshots go: the folder PAGE_PICTURES, or one of pytest's."""
    folder = Path(os.environ.get("PAGE_PICTURES") or tmp_path_factory.mktemp("pictures"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder
