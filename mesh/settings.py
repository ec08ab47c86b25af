"""Settings: one TOML file, then `AIRA_*` variables, then flags; the later wins.

The options keep the names and the defaults of the legacy stack where it had them. An option that does not exist is
an error which names the nearest one that does. The contracts' names are those of the generation unless they are given.
"""

from __future__ import annotations

import difflib
import logging
import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

log = logging.getLogger(__name__)

PREFIX: Final = "AIRA_"
RETIRED: Final = {
    "master_check_interval": "there is no ROS master any more; delete the option",
}
"""Options of the legacy stack that mean nothing here, and why. They are reported, not obeyed."""

NOT_OPTIONS: Final = frozenset({"AIRA_CONFIG", "AIRA_REQUIRE_PEERS", "AIRA_KUBO", "AIRA_PEERS_CACHE"})
"""`AIRA_*` variables that belong to the command line or to the tests, not to the settings."""

LONGEST: Final = 1e9
"""Seconds that an option can be at most, some thirty years: infinity is no number that every file format has."""

PositiveInt = Annotated[int, Meta(ge=1)]
Seconds = Annotated[float, Meta(ge=0, le=LONGEST)]
Interval = Annotated[float, Meta(gt=0, le=LONGEST)]
SecondsOrEver = Annotated[float, Meta(ge=-1, le=LONGEST)]
Gwei = Annotated[float, Meta(ge=1e-9, le=1e9)]

NAMES: Final = {
    "factory_contract": "factory.{}.robonomics.eth",
    "lighthouse_contract": "airalab.lighthouse.{}.robonomics.eth",
    "xrt_contract": "xrt.{}.robonomics.eth",
    "erc20_token": "xrt.{}.robonomics.eth",
}
"""What the contracts are called under the root of a generation."""

CHAIN_SETTINGS: Final = (
    "data_dir",
    "web3_http_provider",
    "web3_ws_provider",
    "ens_contract",
    "factory_contract",
    "xrt_contract",
    "generation",
    "contracts",
    "max_fee_gwei",
    "confirmations",
    "reorg_depth",
    "poll_interval",
)
"""The options that decide which chain is used, and how."""


NETWORK_SETTINGS: Final = ("connect", "connect_timeout", "tls_ca", "tls_certificate", "tls_key")
"""The options that decide which network is joined, and as whom."""

SERVER_SETTINGS: Final = ("log_level", "log_format", "metrics_listen")
"""The options by which an operator sees what a server does."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Every option of the mesh, with its default. See `describe` for what each means."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect_timeout: SecondsOrEver = 10.0
    tls_ca: str = ""
    tls_certificate: str = ""
    tls_key: str = ""
    roster: str = ""
    link: tuple[str, ...] = ()
    data_dir: str = ""
    web3_http_provider: str = "http://127.0.0.1:8545"
    web3_ws_provider: str = "ws://127.0.0.1:8546"
    ipfs_http_provider: str = "http://127.0.0.1:5001"
    ipfs_authorization_file: str = ""
    ipfs_gateway: str = ""
    ipfs_public_providers: tuple[str, ...] = ()
    ipfs_swarm_connect: tuple[str, ...] = ()
    ens_contract: str = ""
    factory_contract: str = ""
    lighthouse_contract: str = ""
    xrt_contract: str = ""
    erc20_token: str = ""
    generation: Literal[3, 5] = 3
    contracts: Literal["mesh", "original"] = "mesh"
    max_fee_gwei: Gwei = 500.0
    confirmations: PositiveInt = 1
    reorg_depth: PositiveInt = 12
    poll_interval: Interval = 1.0
    keyfile: str = ""
    keyfile_password_file: str = ""
    enable_executor: bool = True
    recording_topics: str = ""
    playback: Literal["recorded", "at-once"] = "recorded"
    objective_size_limit: PositiveInt = 256 * 1024 * 1024
    objective_expanded_limit: PositiveInt = 1024 * 1024 * 1024
    fetch_timeout: Seconds = 60.0
    content_limit: PositiveInt = 10 * 1024**3
    open_orders_limit: PositiveInt = 1_000_000
    open_services: bool = False
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    log_format: Literal["human", "json"] = "human"
    metrics_listen: str = ""

    def __post_init__(self) -> None:
        """Names that are not given are those of the generation, from here on: they don't change with it any more."""
        for option, name in NAMES.items():
            if not getattr(self, option):
                msgspec.structs.force_setattr(self, option, name.format(self.generation))

    @property
    def node(self) -> str:
        """The node's address, or several with commas. Raises `ConfigurationError` when there is none."""
        found = self.web3_http_provider.strip() or self.web3_ws_provider.strip()
        if not found:
            raise ConfigurationError(
                "no node of the chain is named: web3_http_provider and web3_ws_provider are both empty",
                hint="give --web3-http-provider http://HOST:8545",
            )
        return found

    @property
    def state_directory(self) -> Path:
        """Where ledger, content and recordings are kept: `data_dir`, or the user's data folder."""
        if self.data_dir:
            return Path(self.data_dir).expanduser()
        base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
        return Path(base).expanduser() / "aira"

    def keyfile_and_password(self) -> tuple[Path, Path]:
        """The keyfile and its password file, for a role that signs.

        Raises `ConfigurationError` when either is not set: there is no default account.
        """
        if not self.keyfile or not self.keyfile_password_file:
            raise ConfigurationError(
                "this needs an account, and keyfile or keyfile_password_file is not set",
                hint="make one with `aira account new`, then give --keyfile and --keyfile-password-file",
            )
        return Path(self.keyfile).expanduser(), Path(self.keyfile_password_file).expanduser()


DEFAULTS: Final = Settings()
"""Every option as it is when nobody sets it."""

MEANING: Final[Mapping[str, str]] = {
    "connect": "Zenoh routers to connect to, tried in turn (several fail over)",
    "listen": "where `aira router` listens",
    "connect_timeout": "seconds to wait for a router at the start;"
    " -1 waits for ever, also for the node, the contracts and files",
    "tls_ca": "the site's certificate (PEM), by which a router and its clients know each other on tls/ endpoints",
    "tls_certificate": "own certificate for tls/ endpoints (PEM), made by `aira identity new`",
    "tls_key": "the key of tls_certificate (PEM)",
    "roster": "who belongs to the site and may do what (TOML); without it a router listens on loopback only",
    "link": "other routers of the site, which a router keeps connected to (each has the role router in the roster)",
    "data_dir": "folder of ledger, content, recordings and sent transactions (default: the user's data folder)",
    "web3_http_provider": "JSON-RPC of the EVM node; several nodes of one chain, http(s) or ws(s), with commas",
    "web3_ws_provider": "JSON-RPC of the EVM node by WebSocket, used where web3_http_provider is set empty",
    "ipfs_http_provider": "RPC of the IPFS daemon (a multiaddr or a URL)",
    "ipfs_authorization_file": "file with the Authorization header that the daemon's RPC wants (empty: none)",
    "ipfs_gateway": "IPFS gateway to read content from besides the daemon (a URL; empty: none)",
    "ipfs_public_providers": "RPCs of further IPFS nodes that are to pin objectives and results",
    "ipfs_swarm_connect": "swarm addresses (/…/p2p/ID) to which the IPFS daemon is kept connected",
    "ens_contract": "address of the ENS registry (empty: the public one, or what the node's deployment says)",
    "factory_contract": "ENS name or address of the factory",
    "lighthouse_contract": "ENS name of the lighthouse, the market to trade on",
    "xrt_contract": "ENS name or address of XRT, the token of stakes and fees",
    "erc20_token": "ENS name or address of the token that pays",
    "generation": "generation of the messages made here and of the contracts' names not given: 3 or 5 (both are read)",
    "contracts": "whose contracts are on the chain: this project's (mesh), or the original ones of the generation",
    "max_fee_gwei": "most that a unit of gas may cost, gwei; nothing is sent while it costs more",
    "confirmations": "blocks until a transaction of ours counts as mined, its own included",
    "reorg_depth": "blocks behind the head in which the chain may still be replaced",
    "poll_interval": "seconds between two looks for new blocks",
    "keyfile": "the account's keyfile (Web3 secret storage)",
    "keyfile_password_file": "file with the keyfile's password",
    "enable_executor": "do the jobs; false only listens",
    "recording_topics": "topics to record, separated by commas (empty: all of the liability's)",
    "playback": "play an objective's messages at their recorded times, or at once",
    "objective_size_limit": "largest objective fetched, bytes",
    "objective_expanded_limit": "largest objective once decompressed, bytes",
    "fetch_timeout": "seconds to look for an objective before the job is given up",
    "content_limit": "bytes of all files kept; beyond, the least recently used go, but never those of unfinished jobs",
    "open_orders_limit": "orders that a provider keeps open at most",
    "open_services": "let anyone on the router have this agent sign, send messages and spend"
    " (rpc/sign, rpc/send, rpc/eth/transfer, transfer_from, approve)",
    "log_level": "the least that is logged: debug, info, warning, error",
    "log_format": "an event of the log as a line for people (human), or as a JSON object (json)",
    "metrics_listen": "HOST:PORT where a server tells its metrics (/metrics) and its health (/health); empty: nowhere",
}
"""What each option means, in a line."""


def load(
    *, path: Path | None = None, environ: Mapping[str, str] | None = None, flags: Mapping[str, Any] | None = None
) -> Settings:
    """The settings from the file at `path`, the `AIRA_*` variables of `environ` and `flags`.

    Without a path the file is the one that `AIRA_CONFIG` names, if it is set. A flag whose value is None was not given.
    Raises `ConfigurationError` for an unreadable file, an unknown option or a value that can't be.
    """
    variables = os.environ if environ is None else environ
    if path is None and variables.get("AIRA_CONFIG"):
        path = Path(variables["AIRA_CONFIG"])
    merged: dict[str, Any] = {}
    if path is not None:
        merged |= _checked(_read_toml(path), where=str(path))
    merged |= _checked(_from_environment(variables), where="the environment")
    given = {name: value for name, value in (flags or {}).items() if value is not None}
    merged |= _checked(given, where="the flags")
    try:
        return msgspec.convert(merged, Settings, strict=False)
    except msgspec.ValidationError as error:
        raise _unusable(error) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"can't read the settings {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} is not TOML: {error}") from None


def _from_environment(environ: Mapping[str, str]) -> dict[str, Any]:
    """The options among the variables; lists are written with commas."""
    found: dict[str, Any] = {}
    for variable, text in environ.items():
        if variable.startswith(PREFIX) and variable not in NOT_OPTIONS:
            name = variable.removeprefix(PREFIX).lower()
            found[name] = _split(text) if isinstance(getattr(DEFAULTS, name, None), tuple) else text
    return found


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _checked(options: dict[str, Any], *, where: str) -> dict[str, Any]:
    """The options without the retired ones, each known by name."""
    kept: dict[str, Any] = {}
    for name, value in options.items():
        if name in RETIRED:
            log.warning("%s in %s has no meaning: %s", name, where, RETIRED[name])
        elif name in Settings.__struct_fields__:
            kept[name] = value
        else:
            raise _unknown(name, where)
    return kept


def _unknown(name: str, where: str) -> ConfigurationError:
    nearest = difflib.get_close_matches(name, Settings.__struct_fields__, n=1, cutoff=0)[0]
    return ConfigurationError(f"unknown option {name!r} in {where}", hint=f"did you mean {nearest!r}?")


def _unusable(error: msgspec.ValidationError) -> ConfigurationError:
    """The same with the option's name in front, which the original has as a path at its end."""
    why, _, path = str(error).partition(" - at `$.")
    name = path.rstrip("`").partition("[")[0]
    return ConfigurationError(f"the setting {name} can't be used: {why}", hint=f"{name}: {MEANING[name]}")
