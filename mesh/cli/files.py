"""Files that commands read and write: by name, in the store, or fetched from the mesh by CID."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mesh.cli.chain_client import own_address
from mesh.cli.output import progress
from mesh.content import Exchange, Store
from mesh.errors import ConfigurationError, InputError
from mesh.settings import NetworkSettings, options_of
from schemas import InvalidCid, parse_cid

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.settings import Settings


def require_new_file(path: Path) -> Path:
    """The same path, if nothing is there and its folder is. Raises `InputError`: no file is written over."""
    if path.exists():
        raise InputError(f"{path} is there already", hint="choose another name, or move it away")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent}", hint="make it first")
    return path


def write_error(path: Path, error: OSError) -> ConfigurationError:
    """What to raise when the disk refuses a file."""
    return ConfigurationError(f"can't write {path}: {error.strerror}")


STORE: Final = ("data_dir", "keyfile")
"""The settings that say which store."""


MESH: Final = (*options_of(NetworkSettings), "fetch_timeout", *STORE)
"""Those that say also where a file comes from that is not there."""


LARGEST: Final = 8 << 30
"""Bytes of the largest file that commands take."""


def open_store(settings: Settings) -> Store:
    """The store of the agent whose keyfile is in the settings, or else one for whoever has no account.

    Opening and what is done with it block on the disk; use threads. Raises `ConfigurationError`.
    """
    address = own_address(settings)
    folder = settings.state_directory / address if address else settings.state_directory
    return Store(folder / "content", limit=LARGEST, quota=settings.content_limit)


@asynccontextmanager
async def opened_store(settings: Settings) -> AsyncIterator[Store]:
    """The same, to be closed in the end."""
    store = await asyncio.to_thread(open_store, settings)
    try:
        yield store
    finally:
        store.close()


async def fetch(settings: Settings, store: Store, cid: str) -> Path:
    """Where the file of that CID is in the store; it is fetched from the mesh if it is not there yet.

    Raises `InvalidCid`, `NetworkUnavailable`, `ContentUnavailable` and other branches of `ContentError`.
    """
    from mesh.composition import endpoints_of
    from mesh.network import Network

    parse_cid(cid)
    held = await asyncio.to_thread(store.checked, cid)
    if held is not None:
        return held
    async with Network(endpoints_of(settings)) as network, Exchange(network.session, store) as exchange:
        with progress(f"fetching {cid[:8]}…") as tell:
            return await exchange.fetch(cid, timeout=settings.fetch_timeout, progress=tell)


def file_or_cid(text: str) -> Path | str:
    """A file where there is one of that name, else a CID. Raises `InputError` if it is neither."""
    path = Path(text)
    if path.exists():
        return path
    try:
        parse_cid(text)
    except InvalidCid:
        raise InputError(
            f"{text!r} is neither a file nor a CID", hint="name a file that is there, or a CID of 46 characters (Qm…)"
        ) from None
    return text


def require_readable(path: Path) -> Path:
    """The same path, if a file that can be read is there. Raises `InputError`."""
    try:
        if path.is_dir():
            raise InputError(f"can't read {path}: it is a folder")
        with path.open("rb"):
            return path
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror}") from None
