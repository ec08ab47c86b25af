"""Files that commands read and write: by name, in the store, or fetched from the mesh by CID."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from mesh.background import Background
from mesh.cli.chain_client import own_address
from mesh.cli.errors import FileExists, FileUnreadable, FileUnwritable, FolderMissing, NotAFileOrCid, NotAModel
from mesh.cli.output import printable, progress, short_address
from mesh.content import Exchange, Store
from mesh.settings import NetworkSettings, options_of
from schemas import InvalidCid, cid_of_file, parse_cid
from schemas.address import is_ens_name

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.network import Network
    from mesh.settings import Settings

STORE_SETTINGS: Final = ("data_dir", "keyfile")
"""The settings that locate the store."""
FETCH_SETTINGS: Final = (*options_of(NetworkSettings), "fetch_timeout", *STORE_SETTINGS)
"""The settings to find a file in the store or fetch it from the mesh."""
NOTICE: Final = 0.5
"""Seconds after which a command says what it waits for."""
PEERS_NAMED: Final = 3
"""Peers that are named when a file is looked for."""
LARGEST_FILE: Final = 8 << 30
"""Bytes of the largest file that commands put into the store."""


def require_readable(path: Path) -> Path:
    """Return the path if it is a file that can be read. Raises `FileUnreadable`."""
    try:
        if path.is_dir():
            raise FileUnreadable(f"can't read {path}: it is a directory")
        with path.open("rb"):
            return path
    except OSError as error:
        raise FileUnreadable(f"can't read {path}: {error.strerror}") from None


def require_new_file(path: Path) -> Path:
    """Return the path if a new file can be created there: no file is overwritten. Raises `InputError`."""
    if path.exists():
        raise FileExists(f"{path} already exists", hint="choose another name, or move the file")
    if not path.parent.is_dir():
        raise FolderMissing(f"the directory {path.parent} does not exist", hint="create it first")
    return path


def require_writable(path: Path) -> None:
    """Check that a file can be written there. Leaves no file behind. Raises `FileUnwritable`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise write_error(path, error) from None


def write_error(path: Path, error: OSError) -> FileUnwritable:
    """The error for a file that the system refuses to write."""
    return FileUnwritable(f"can't write {path}: {error.strerror}")


def file_or_cid(text: str) -> Path | str:
    """The path of the file with that name if there is one, else the CID. Raises `NotAFileOrCid`."""
    path = Path(text)
    if path.exists():
        return path
    try:
        parse_cid(text)
    except InvalidCid:
        raise NotAFileOrCid(
            f"{text!r} is neither a file nor a CID", hint="give an existing file, or a CID of 46 characters (Qm…)"
        ) from None
    return text


def require_model(text: str) -> str:
    """Return the text if it may be a model. Raises `NotAModel`."""
    if is_ens_name(text):
        return text
    try:
        parse_cid(text)
    except InvalidCid:
        hint = "`aira cid FILE` prints the CID of a model's file"
        if Path(text).is_file():
            hint = f"`aira cid {text}` prints its CID: {cid_of_file(Path(text))}"
        raise NotAModel(f"{printable(text[:60])!r} is neither the CID nor the ENS name of a model", hint=hint) from None
    return text


def open_store(settings: Settings) -> Store:
    """The store of the settings' account; without an account, the store that the data folder has for no account.

    This and the store's methods block on the disk; use threads. Raises `ConfigurationError`.
    """
    address = own_address(settings)
    folder = settings.state_directory / address if address else settings.state_directory
    return Store(folder / "content", limit=LARGEST_FILE, quota=settings.content_limit)


@asynccontextmanager
async def opened_store(settings: Settings) -> AsyncIterator[Store]:
    """`open_store` in a thread; the store is closed at the end."""
    store = await asyncio.to_thread(open_store, settings)
    try:
        yield store
    finally:
        store.close()


async def fetch(settings: Settings, store: Store, cid: str, *, size_limit: int | None = None) -> Path:
    """The path of the file with that CID in the store, fetched from the mesh if the store does not have it.

    If that takes more than a moment, says on stderr what it waits for, which peers it asks, and when it gives up.
    `size_limit` is in bytes. Raises `InvalidCid`, `NetworkUnavailable`, `ContentUnavailable` and other `ContentError`s.
    """
    from mesh.composition import endpoints_of
    from mesh.network import Network

    parse_cid(cid)
    held = await asyncio.to_thread(store.checked, cid)
    if held is not None:
        return held
    waits = f"aira: {cid} is not in the store; connecting to {', '.join(settings.connect)}"
    waits += f" for at most {settings.connect_timeout:g} s"
    connecting = asyncio.get_running_loop().call_later(NOTICE, partial(click.echo, waits, err=True))
    try:
        async with Network(endpoints_of(settings)) as network, Exchange(network.session, store) as exchange:
            connecting.cancel()
            async with Background() as tasks:
                tasks.start(_say_who_is_asked(settings, network, cid), "notice")
                with progress(f"fetching {cid[:8]}…") as report:
                    return await exchange.fetch(
                        cid, size_limit=size_limit, timeout=settings.fetch_timeout, progress=report
                    )
    finally:
        connecting.cancel()


async def _say_who_is_asked(settings: Settings, network: Network, cid: str) -> None:
    """Say whom a file is asked of, and when that ends, unless it arrives at once."""
    await asyncio.sleep(NOTICE)
    patience = f"gives up after {settings.fetch_timeout:g} s without an answer"
    click.echo(f"aira: {cid} is not in the store; asking {await _peers(settings, network)}; {patience}", err=True)


async def _peers(settings: Settings, network: Network) -> str:
    """Who is asked for a file: the agents and bridges that are present on the settings' lighthouse, and all others."""
    from mesh.network import Channel
    from mesh.watching import present

    name, timeout = settings.lighthouse_contract, settings.answer_timeout
    async with Channel(network.session, name, answer_timeout=timeout) as channel:
        peers = await present(channel, "agent", "bridge")
    named = ", ".join(f"{peer.role} {short_address(peer.address)}" for peer in peers[:PEERS_NAMED])
    more = f" and {len(peers) - PEERS_NAMED} more" if len(peers) > PEERS_NAMED else ""
    who = f"{named}{more}" if peers else f"all peers (none is present on {settings.lighthouse_contract})"
    return f"{who} through {', '.join(settings.connect)}"
