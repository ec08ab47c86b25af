"""Files that commands read and write: by name, in the store, or fetched from the mesh by CID; and Python programs of
users, from which commands take an agent or a validator without starting it."""

from __future__ import annotations

import asyncio
import os
import runpy
import sys
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from traceback import extract_tb
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn, TypeVar

import click

from mesh.base.background import Background
from mesh.cli.chain_client import own_address
from mesh.cli.output import printable, progress, short_address
from mesh.errors import AiraError, ConfigurationError, InputError
from mesh.settings import NetworkSettings
from schemas import InvalidCid, cid_of_file, parse_cid
from schemas.address import is_ens_name
from schemas.decoding import without_mark
from schemas.model import DESCRIPTION_LIMITS, is_description, parse_description, read_description

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mesh.agent.agent import Agent, Messages
    from mesh.content import Store
    from mesh.network import Network
    from mesh.settings import Settings
    from schemas.model import ModelDescription

K = TypeVar("K")

STORE_SETTINGS: Final = ("data_dir", "keyfile")
"""The settings that locate the store."""
FETCH_SETTINGS: Final = (NetworkSettings, "fetch_timeout", *STORE_SETTINGS)
"""The settings to find a file in the store or fetch it from the mesh."""
NOTICE: Final = 0.5
"""Seconds after which a command says what it waits for."""
LARGEST_FILE: Final = 8 << 30
"""Bytes of the largest file that commands put into the store."""


def require_readable(path: Path) -> Path:
    """Return the path if it is a file that can be read. Raises `InputError`."""
    try:
        if path.is_dir():
            raise InputError(f"can't read {path}: it is a directory", code="file-unreadable")
        with path.open("rb"):
            return path
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror}", code="file-unreadable") from None


def read_message(path: Path) -> bytes:
    """The JSON in a file. Raises `InputError`, `InvalidData`."""
    return without_mark(require_readable(path).read_bytes())


def require_new_file(path: Path) -> Path:
    """Return the path if a new file can be created there: no file is overwritten. Raises `InputError`."""
    if path.exists():
        raise InputError(f"{path} already exists", hint="choose another name, or move the file", code="file-exists")
    if not path.parent.is_dir():
        raise InputError(f"the directory {path.parent} does not exist", hint="create it first", code="folder-missing")
    return path


def require_writable(path: Path) -> None:
    """Check that a file can be written there. Leaves no file behind. Raises `ConfigurationError`."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        path.open("ab").close()
        if not existed:
            path.unlink()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the `OSError` of a file that the system refuses to write into a `ConfigurationError`."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror}", code="file-unwritable") from None


def names_in(text: str) -> frozenset[str]:
    """Names that are separated by commas, such as topics."""
    return frozenset(name.strip() for name in text.split(",") if name.strip())


def file_or_cid(text: str) -> Path | str:
    """The path of the file or folder with that name if there is one, else the CID. Raises `InputError`."""
    path = Path(text)
    if path.exists():
        return path if path.is_dir() else require_readable(path)
    try:
        parse_cid(text)
    except InvalidCid:
        raise InputError(
            f"{text!r} is neither a file nor a CID",
            hint="give an existing file, or a CID of 46 characters (Qm…)",
            code="not-a-file-or-cid",
        ) from None
    return text


def objective_given(objective: str | None, messages: Messages) -> Path | str | Messages:
    """What `--objective` names, or the messages of `--message`: one of them has to be given. Raises `InputError`."""
    if (objective is None) == (not messages):
        raise InputError(
            "give --objective or --message, and not both",
            hint="""--objective FILE, or as often as needed --message '/topic {"field": 1}'""",
            code="invalid-options",
        )
    return messages if objective is None else file_or_cid(objective)


async def objective_of(agent: Agent, given: Path | str | Messages) -> str:
    """The CID of what `objective_given` returned, once the agent's store has the file. Raises `InputError`.

    Messages get the types that the description of the agent's model says.
    """
    if isinstance(given, str):
        return given
    if isinstance(given, Path):
        return await agent.add(given)
    description = await agent.runtime.models.find(await agent.parts.chain.names.model(agent.model))
    with TemporaryDirectory(prefix="aira-messages-") as folder:
        path = Path(folder) / "objective.mcap"
        from mesh.recording import pack_described

        await asyncio.to_thread(pack_described, given, path, description)
        return await agent.add(path)


class NamedModel(NamedTuple):
    """What `--model` names: a model by its CID or its ENS name, and the file, if that was given and others read it."""

    name: str
    file: Path | None = None

    def cid(self) -> str:
        """The CID, for commands without a chain. Raises `InvalidCid`."""
        parse_cid(self.name)
        return self.name


def model_named(text: str) -> NamedModel:
    """The model with that file if there is one, else that CID or ENS name. Reads the file.

    Raises `InputError`, and `InvalidDescription` for a file NAME.json that is no description.
    """
    path = Path(text)
    if os.path.isfile(text):  # any text may be given; Path.is_file raises for some
        description_of(require_readable(path))
        is_read = path.stat().st_size <= DESCRIPTION_LIMITS.size
        return NamedModel(cid_of_file(path), path if is_read else None)
    try:
        if not is_ens_name(text):
            parse_cid(text)
    except InvalidCid:
        said = f"{printable(text[:60])!r} is neither a file, nor the CID or the ENS name of a model"
        raise InputError(
            said, hint="give the model's file, or its CID of 46 characters (Qm…)", code="not-a-model"
        ) from None
    return NamedModel(text)


def description_of(path: Path) -> ModelDescription | None:
    """The description in a model's file, which NAME.json has to be. Raises `InvalidDescription`."""
    with path.open("rb") as file:
        data = file.read(DESCRIPTION_LIMITS.size + 1)
    return read_description(data) if path.suffix == ".json" or is_description(data) else None


def required_description(path: Path) -> ModelDescription:
    """The description of a model in a file, which has to be one. Raises `InputError`, `InvalidDescription`."""
    with require_readable(path).open("rb") as file:
        return parse_description(file.read(DESCRIPTION_LIMITS.size + 1))


def account_store(settings: Settings) -> Store:
    """The store of the settings' account; without an account, the store that the data folder has for no account.

    This and the store's methods block on the disk; use threads. Raises `ConfigurationError`.
    """
    from mesh.content.store import make_store

    address = own_address(settings)
    folder = settings.state_directory / address if address else settings.state_directory
    return make_store(settings, folder / "content", limit=LARGEST_FILE)


@asynccontextmanager
async def opened_store(settings: Settings) -> AsyncIterator[Store]:
    """`account_store` in a thread; the store is closed at the end."""
    store = await asyncio.to_thread(account_store, settings)
    try:
        yield store
    finally:
        store.close()


async def fetch(settings: Settings, store: Store, cid: str, *, size_limit: int | None = None) -> Path:
    """The path of the file with that CID in the store, fetched from the mesh if the store does not have it.

    If that takes more than a moment, says on stderr what it waits for, which peers it asks, and when it gives up.
    `size_limit` is in bytes. Raises `InvalidCid`, `NetworkUnavailable`, `ContentUnavailable` and other `ContentError`s.
    """
    from mesh.content import Exchange
    from mesh.network import Endpoints, Network

    parse_cid(cid)
    held = await asyncio.to_thread(store.checked, cid)
    if held is not None:
        return held
    waits = f"aira: {cid} is not in the store; connecting to {', '.join(settings.connect)}"
    waits += f" for at most {settings.connect_timeout:g} s"
    connecting = asyncio.get_running_loop().call_later(NOTICE, partial(click.echo, waits, err=True))
    try:
        async with Network(Endpoints.from_settings(settings)) as network, Exchange(network.session, store) as exchange:
            connecting.cancel()
            async with Background() as tasks:
                tasks.start(_say_who_is_asked(settings, network, cid), "notice")
                with progress(f"fetching {cid[:8]}…") as report:
                    return await exchange.fetch(
                        cid, size_limit=size_limit, timeout=settings.fetch_timeout, progress=report
                    )
    finally:
        connecting.cancel()


async def file_of(settings: Settings, store: Store, named: str) -> Path:
    """The file with that name if there is one, else that with the CID, as `fetch`. Raises `InputError`."""
    found = file_or_cid(named)
    return require_readable(found) if isinstance(found, Path) else await fetch(settings, store, found)


async def _say_who_is_asked(settings: Settings, network: Network, cid: str) -> None:
    """Say whom a file is asked of, and when that ends, unless it arrives at once: the agents and bridges that are
    present on the settings' lighthouse, and all others."""
    from mesh.network import Channel
    from mesh.watching import present

    await asyncio.sleep(NOTICE)
    name, timeout = settings.lighthouse_contract, settings.answer_timeout
    async with Channel(network.session, name, answer_timeout=timeout) as channel:
        peers = await present(channel, "agent", "bridge")
    first, others = peers[:3], peers[3:]
    named = ", ".join(f"{peer.role} {short_address(peer.address)}" for peer in first)
    more = f" and {len(others)} more" if others else ""
    who = f"{named}{more}" if peers else f"all peers (none is present on {name})"
    patience = f"gives up after {settings.fetch_timeout:g} s without an answer"
    asked = f"asking {who} through {', '.join(settings.connect)}"
    click.echo(f"aira: {cid} is not in the store; {asked}; {patience}", err=True)


def run_program(path: Path, kind: type[Any]) -> dict[str, Any]:
    """The names that a Python program has, which is run without starting its agent (`kind`).

    Raises `InputError`, and any `AiraError` of the program.
    """
    with _importing_from(path.parent), _not_running(kind, path) as started:
        try:
            return runpy.run_path(str(path), run_name=path.stem)
        except AiraError:
            raise
        except (Exception, SystemExit) as error:  # whatever the program raises
            if started:  # `run_to_end` has reported it
                raise
            lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
            where = f"{path}:{lines[-1]}" if lines else str(path)
            why = " ".join(str(error).split())
            raise InputError(f"can't run {where}: {type(error).__name__}: {why}", code="program-unusable") from error


def only(names: dict[str, Any], kind: type[K], path: Path, *, hint: str) -> K | None:
    """The one object of that kind that a program has, None if there is none. Raises `InputError` for several."""
    found = {name: value for name, value in names.items() if isinstance(value, kind)}
    if len(set(map(id, found.values()))) > 1:
        raise InputError(
            f"{path} has several objects {kind.__name__}: {', '.join(sorted(found))}",
            hint=hint,
            code="program-unusable",
        )
    return next(iter(found.values()), None)


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Import modules from there, as a program does that Python runs."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


@contextmanager
def _not_running(kind: type[Any], path: Path) -> Iterator[list[Any]]:
    """Let `agent.run()`, with which many programs end, do nothing, and let `async with agent` fail.

    Yields the list of the agents that the program would have started.
    """
    run, enter = kind.run, kind.__aenter__
    started: list[Any] = []

    async def refuse(agent: Any) -> NoReturn:
        started.append(agent)
        raise InputError(
            f"{path} starts its {kind.__name__.lower()}",
            hint='do that below `if __name__ == "__main__":`',
            code="program-unusable",
        )

    kind.run, kind.__aenter__ = lambda agent: None, refuse
    try:
        yield started
    finally:
        kind.run, kind.__aenter__ = run, enter
