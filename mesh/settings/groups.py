"""The options in groups: each part of the mesh takes the group it needs; `Settings` is all of them.

Options keep the names and the defaults of the legacy stack where it had them. They are loaded from one TOML file, then
`AIRA_*` variables, then flags; the later wins.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar, get_args

import msgspec
from msgspec import Meta

from mesh.base.log_context import log_event
from mesh.errors import ConfigurationError, nearest
from mesh.settings.chains import ANY, CHAINS, FILLED, ChainProfile
from schemas.decoding import InvalidData, decode_toml, text_of

if TYPE_CHECKING:
    from collections.abc import Mapping

log = logging.getLogger(__name__)

LONGEST: Final = 1e9
"""The most seconds that an option can hold, about thirty years: not every file format can express infinity."""

PositiveInt = Annotated[int, Meta(ge=1)]
NaturalInt = Annotated[int, Meta(ge=0)]
Seconds = Annotated[float, Meta(ge=0, le=LONGEST)]
Interval = Annotated[float, Meta(gt=0, le=LONGEST)]
SecondsOrEver = Annotated[float, Meta(ge=-1, le=LONGEST)]
Gwei = Annotated[float, Meta(ge=1e-9, le=1e9)]

Line = Annotated[str, Meta(max_length=80)]
Sentence = Annotated[str, Meta(max_length=200)]

T = TypeVar("T")


def option(default: T, meaning: str) -> T:
    """A field of a group: its default, and one line that explains it."""
    return field(default=default, metadata={"meaning": meaning})


DEADLINE_LIMIT: Final = ANY.deadline_limit
"""Blocks, about a day where one takes 12 seconds."""
OPEN_ORDERS_LIMIT: Final = 16_384
"""Orders in a provider's book. With up to 2 KB each, a provider stays below 200 MB."""


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """How a client joins the Zenoh network."""

    connect: tuple[str, ...] = option(
        ("tcp/127.0.0.1:7447",), "Zenoh routers to connect to, tried in order; with several, the client fails over"
    )
    connect_timeout: SecondsOrEver = option(
        10.0, "seconds to wait for a router at startup; -1 waits forever, also for the node, the contracts and files"
    )
    answer_timeout: Interval = option(
        5.0, "seconds to wait for the answers of others, such as a validator's jurors and the providers"
    )
    tls_ca: str = option(
        "", "the site's CA certificate (PEM); routers and clients on tls/ endpoints are checked with it"
    )
    tls_certificate: str = option(
        "", "this client's certificate for tls/ endpoints (PEM), created by `aira identity new`"
    )
    tls_key: str = option("", "the key of tls_certificate (PEM)")
    shared_memory: bool = option(
        False, "exchange large payloads with other processes of this machine in shared memory, which each session locks"
    )


@dataclass(frozen=True, kw_only=True)
class RouterSettings(NetworkSettings):
    """What `aira router` needs besides its certificate."""

    listen: tuple[str, ...] = option(("tcp/127.0.0.1:7447",), "endpoints that `aira router` listens on")
    roster: str = option(
        "", "the site's members and their rights (TOML); without a roster the router listens on loopback only"
    )
    link: tuple[str, ...] = option(
        (), "other routers of the site to stay connected to (each has the role router in the roster)"
    )
    max_sessions: PositiveInt = option(
        10_000, "most sessions that `aira router` holds at a time; each needs a file descriptor"
    )
    blocked_sessions: str = option(
        "",
        "file of sessions that `aira router` ends, one a line: a Zenoh id, the address in a certificate, an IP address"
        " or a network; read again when it changes (empty: none)",
    )


@dataclass(frozen=True, kw_only=True)
class StorageSettings:
    """Where state is kept."""

    data_dir: str = option(
        "", "folder for ledgers, content, recordings, transactions and withdrawals (default: the user's data folder)"
    )

    @property
    def state_directory(self) -> Path:
        """`data_dir`, or the user's data folder."""
        if self.data_dir:
            return Path(self.data_dir).expanduser()
        base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
        return Path(base).expanduser() / "aira"


@dataclass(frozen=True, kw_only=True)
class ChainSettings(StorageSettings):
    """Which chain is used, and how.

    What is 0 here is the chain's, which `Settings` fills in.
    """

    chain: Literal["", "base", "optimism", "arbitrum", "gnosis", "polygon", "ethereum", "sepolia", "local"] = option(
        "",
        "the chain by name: base, optimism, arbitrum, gnosis, polygon, ethereum, sepolia or local; options that are not"
        " given and say [the chain's …] are its own, and other chains are refused (empty: any chain)",
    )
    web3_http_provider: str = option(
        "http://127.0.0.1:8545", "JSON-RPC of the EVM node; separate several nodes of one chain (http or ws) by commas"
    )
    web3_ws_provider: str = option(
        "ws://127.0.0.1:8546", "JSON-RPC of the EVM node over WebSocket; used when web3_http_provider is empty"
    )
    ens_contract: str = option(
        "", "address of the ENS registry (empty: the public registry, or the one of a development chain)"
    )
    factory_contract: str = option("", "ENS name or address of the factory")
    xrt_contract: str = option("", "ENS name or address of XRT, the token of stakes and fees")
    generation: Literal[3, 5] = option(
        3, "message format and contract names to use by default, 3 or 5 (both formats are always read)"
    )
    contracts: Literal["mesh", "original"] = option(
        "mesh", "which contracts are deployed: this project's (mesh), or the originals of the generation (original)"
    )
    max_fee_gwei: Gwei = option(500.0, "highest gas price to pay, gwei; nothing is sent while gas costs more")
    confirmations: PositiveInt = option(
        0, "blocks until what happened in one counts, its own block included [the chain's, else 1]"
    )
    finality: Literal["latest", "safe", "finalized"] = option(
        "latest",
        "which blocks count before a robot begins a job, a provider is done with one, and a demand is paid: those with"
        " confirmations (latest), or those that the node calls safe or finalized",
    )
    reorg_depth: PositiveInt = option(
        0, "how many blocks behind the head a reorganisation is still detected [the chain's, else 12]"
    )
    poll_interval: Interval = option(0.0, "seconds between polls for new blocks [the chain's, else 1]")
    known_validators: tuple[str, ...] = option(
        (),
        "names or addresses of further contracts that your orders may name as validators; juries of this project and"
        " accounts that have sent a transaction need no entry",
    )

    @property
    def profile(self) -> ChainProfile:
        """What is known of the chain that is named."""
        return CHAINS.get(self.chain, ANY)

    @property
    def node(self) -> str:
        """The node's URL, or several separated by commas. Raises `ConfigurationError`."""
        found = self.web3_http_provider.strip() or self.web3_ws_provider.strip()
        if not found:
            raise ConfigurationError(
                "no EVM node is configured: web3_http_provider and web3_ws_provider are both empty",
                hint="pass --web3-http-provider http://HOST:8545",
                code="node-not-set",
            )
        return found


@dataclass(frozen=True, kw_only=True)
class AccountSettings:
    """The account that signs."""

    keyfile: str = option("", "the account's keyfile (Web3 Secret Storage)")
    keyfile_password_file: str = option("", "file with the keyfile's password")

    def keyfile_and_password(self) -> tuple[Path, Path]:
        """The keyfile and its password file. Raises `ConfigurationError`."""
        if not self.keyfile or not self.keyfile_password_file:
            raise ConfigurationError(
                "this needs an account, and keyfile or keyfile_password_file is not set",
                hint="create one with `aira account new`, then pass --keyfile and --keyfile-password-file",
                code="account-not-set",
            )
        return Path(self.keyfile).expanduser(), Path(self.keyfile_password_file).expanduser()


@dataclass(frozen=True, kw_only=True)
class MarketSettings:
    """The market to trade on."""

    lighthouse_contract: str = option("", "ENS name of the lighthouse, the market to trade on")
    erc20_token: str = option(
        "", "the token that pays for work: its address, its ENS name, or its symbol if it is known on the chain (USDC)"
    )
    open_orders_limit: PositiveInt = option(OPEN_ORDERS_LIMIT, "most open orders that a provider keeps, 2 KB each")
    unmined_limit: PositiveInt = option(
        16, "most transactions of a provider that wait to be mined; some nodes keep no more of one account"
    )
    free_contracts: NaturalInt = option(
        100, "contracts a day that a provider creates although they don't cover its gas; a quarter of them at once"
    )
    customers: tuple[str, ...] = option(
        (), "addresses whose orders a provider always makes contracts of, also if these don't cover its gas"
    )
    deadline_limit: PositiveInt = option(
        0,
        "blocks after which a provider drops an order, and an agent's offer for a demand ends, before its deadline"
        " [a day of the chain's, else 7200]",
    )
    accepted_validators: str = option(
        "any",
        "validators under which an agent works for demands: any, none, or names and addresses, separated by commas",
    )
    blocked_signers: str = option(
        "", "file of addresses, one a line, whose messages are dropped; read again when it changes (empty: none)"
    )


@dataclass(frozen=True, kw_only=True)
class ValidatorSettings:
    """How a validator judges."""

    validator_contract: str = option(
        "",
        "ENS name or address of the contract that this juror judges for (empty: only its own account, in generation 3)",
    )
    validator_policies: tuple[str, ...] = option(
        ("complete",), "policies to judge by: complete (always on), acknowledged, schema, rate"
    )
    validator_fee: str = option("0", "least fee, in XRT (0.1) or wn (100wn); a job that pays less never counts")
    validator_bags: bool = option(
        False, "also accept ROS 1 bags, as robots of the legacy network hand in: less of them can be checked"
    )
    validator_title: str = option("", "the validator's title in its announcement, for people")
    validator_check_timeout: Interval = option(
        60.0, "seconds that an own check may take for a recording; a result whose check takes longer is not judged"
    )


@dataclass(frozen=True, kw_only=True)
class ContentSettings:
    """Limits for files behind CIDs."""

    content_limit: PositiveInt = option(
        10 * 1024**3,
        "most bytes of content to keep; the least recently used files are evicted first, never those of open jobs",
    )
    objective_size_limit: PositiveInt = option(256 * 1024 * 1024, "largest objective to fetch, bytes")
    objective_expanded_limit: PositiveInt = option(1024 * 1024 * 1024, "largest objective once decompressed, bytes")
    fetch_timeout: Seconds = option(60.0, "seconds to look for an objective before the job fails")


@dataclass(frozen=True, kw_only=True)
class ExecutionSettings(ContentSettings):
    """How jobs are done."""

    enable_executor: bool = option(True, "run jobs; false only listens")
    recording_topics: str = option("", "topics to record, separated by commas (empty: all topics of the liability)")
    playback: Literal["recorded", "at-once"] = option(
        "recorded", "play an objective's messages at their recorded times, or all at once"
    )
    bag_results: bool = option(
        False,
        "hand in a ROS 1 bag as the result of a job whose objective is one, as the people of the legacy network expect;"
        " validators accept no bags unless they are set to",
    )
    hold_when_stopped: bool = option(
        False, "after a job was stopped, take and begin no other one until it is released (`aira stop --release`)"
    )
    open_services: bool = option(
        False,
        "let anyone on the router make this agent sign, send messages and spend (rpc/sign, rpc/send,"
        " rpc/eth/transfer, transfer_from, approve), control it as its owner (rpc/control), and drive the jobs"
        " of its handlers (rpc/start, finish, restart, resume)",
    )


@dataclass(frozen=True, kw_only=True)
class ProfileSettings:
    """How a robot presents itself to those who order."""

    name: Line = option("", "the robot's name, for people; anybody may choose the same")
    about: Sentence = option("", "one sentence about the robot, for people")
    picture: str = option("", "picture of the robot: a PNG, JPEG or WebP file of at most 512 KiB, or its CID")
    place: Line = option("", "where the robot is, for people")


@dataclass(frozen=True, kw_only=True)
class AcceptanceSettings:
    """Which jobs an agent takes."""

    queue_limit: NaturalInt = option(
        0, "most jobs that an agent has at a time: those that run, wait, or were offered (0: no limit)"
    )
    least_price: str = option(
        "", "least cost of a job that an agent takes: 1.5, in the token erc20_token, or 3.50 USDC (empty: any)"
    )
    accept: tuple[str, ...] = option((), "addresses of the only customers that an agent works for (empty: all)")
    refuse: tuple[str, ...] = option((), "addresses of customers that an agent never works for (banned)")
    accept_values: str = option(
        "",
        "file (TOML) with the topics, and the values of their fields, that an agent takes in orders of anybody, as"
        " [topics] in a signer's policy (empty: all that its model has)",
    )
    hours: tuple[str, ...] = option(
        (), "when an agent takes jobs, as in 'Mon-Fri 08:00-18:00 Europe/Berlin' (empty: always)"
    )


OwnerEvent = Literal[
    "job-offered", "job-begun", "job-failed", "job-paid", "job-refunded", "robot-unreachable", "low-on-gas"
]
"""What the owner of a robot can be notified of."""


@dataclass(frozen=True, kw_only=True)
class NotificationSettings:
    """Who is told what happens to a robot."""

    notify: tuple[str, ...] = option(
        (), "URLs (https://…) and programs (/usr/local/bin/say) that are told what happens to the robot, as CloudEvents"
    )
    notify_events: tuple[OwnerEvent, ...] = option(get_args(OwnerEvent), "what they are told")
    notify_secret_file: str = option("", "file with the secret that signs what URLs are told (empty: not signed)")


@dataclass(frozen=True, kw_only=True)
class IpfsSettings:
    """How to reach IPFS."""

    ipfs_http_provider: str = option("http://127.0.0.1:5001", "RPC of the IPFS daemon (a multiaddr or a URL)")
    ipfs_authorization_file: str = option("", "file with the Authorization header for the daemon's RPC (empty: none)")
    ipfs_gateway: str = option("", "IPFS gateway to read content from besides the daemon (a URL; empty: none)")
    ipfs_public_providers: tuple[str, ...] = option(
        (), "RPCs of further IPFS nodes that should pin objectives and results"
    )
    ipfs_large_numbers: bool = option(
        False, "pass orders of generation 3 with numbers over 32 bits to IPFS, where older nodes stop at them"
    )
    ipfs_swarm_connect: tuple[str, ...] = option((), "swarm addresses (/…/p2p/ID) to keep the IPFS daemon connected to")


@dataclass(frozen=True, kw_only=True)
class Ros2Settings:
    """How to reach a ROS 2 system."""

    ros2_connect: tuple[str, ...] = option(
        ("tcp/127.0.0.1:7447",), "Zenoh routers of the ROS 2 system, tried in order; never those of the mesh"
    )
    ros2_distribution: str = option("jazzy", "ROS 2 distribution of that system: humble, jazzy, kilted, …")


@dataclass(frozen=True, kw_only=True)
class EdgeSettings:
    """How an edge agent treats its device."""

    agent_silence: Seconds = option(
        0.0, "seconds without an answer of the agent in a job, after which `aira edge` stops its device (0: never)"
    )


@dataclass(frozen=True, kw_only=True)
class TelemetrySettings:
    """How an operator sees what a server does."""

    log_level: Literal["debug", "info", "warning", "error"] = option(
        "info", "lowest level to log: debug, info, warning, error"
    )
    log_format: Literal["human", "json"] = option(
        "human", "log lines for people (human) or one JSON object each (json)"
    )
    metrics_listen: str = option(
        "", "HOST:PORT for a server's metrics (/metrics) and health (/health); empty: not served"
    )


CONTRACT_NAMES: Final = {
    "factory_contract": "factory.{}.robonomics.eth",
    "lighthouse_contract": "airalab.lighthouse.{}.robonomics.eth",
    "xrt_contract": "xrt.{}.robonomics.eth",
    "erc20_token": "xrt.{}.robonomics.eth",
}
"""What the contracts are called in each generation."""


@dataclass(frozen=True, kw_only=True)
class Settings(
    TelemetrySettings,
    EdgeSettings,
    Ros2Settings,
    IpfsSettings,
    ValidatorSettings,
    ProfileSettings,
    AcceptanceSettings,
    NotificationSettings,
    ExecutionSettings,
    MarketSettings,
    AccountSettings,
    ChainSettings,
    RouterSettings,
):
    """Every option of the mesh, with its default."""

    _filled: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    """What the chain filled in: `dataclasses.replace(settings, chain=…)` fills it in again."""

    def __post_init__(self) -> None:
        """Contract names that are not given are those of the generation; other options are those of the chain."""
        for name, template in CONTRACT_NAMES.items():
            if not getattr(self, name):
                object.__setattr__(self, name, template.format(self.generation))
        filled = {}
        for name in FILLED:
            if not (given := getattr(self, name)) or given == self._filled.get(name):
                filled[name] = getattr(self.profile, name)
                object.__setattr__(self, name, filled[name])
        object.__setattr__(self, "_filled", filled)


def options_of(group: type) -> tuple[str, ...]:
    """The names of a group's options, in order."""
    return tuple(each.name for each in fields(group) if "meaning" in each.metadata)


OPTIONS: Final = options_of(Settings)
MEANING: Final[Mapping[str, str]] = {
    each.name: each.metadata["meaning"] for each in fields(Settings) if "meaning" in each.metadata
}
"""What each option means, in one line."""
DEFAULTS: Final = Settings()
"""Every option with its default."""

PREFIX: Final = "AIRA_"
RETIRED: Final = {"master_check_interval": "there is no ROS master; delete the option"}
"""Options of the legacy stack that have no meaning here, and why. They are logged and ignored."""

NOT_OPTIONS: Final = frozenset(
    {
        "AIRA_CONFIG",
        *("AIRA_REQUIRE_PEERS", "AIRA_PEERS_CACHE", "AIRA_MCAP", "AIRA_ORIGINAL_CONTRACTS"),
        *("AIRA_MODEL_HISTORIES", "AIRA_MONEY_HISTORIES", "AIRA_TURN_HISTORIES", "AIRA_SIMULATION_TRACEBACKS"),
    }
)
"""`AIRA_*` variables that belong to the command line or to the tests, not to the settings."""


def load(
    *, path: Path | None = None, environ: Mapping[str, str] | None = None, flags: Mapping[str, Any] | None = None
) -> Settings:
    """The settings from the file at `path`, the `AIRA_*` variables of `environ` and `flags`.

    Without a path, `AIRA_CONFIG` names the file, if it is set. A flag whose value is None was not given.
    Raises `ConfigurationError`.
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
        why, _, place = str(error).partition(" - at `$.")
        name = place.rstrip("`").partition("[")[0]
        hint = f"{name}: {MEANING[name]}"
        raise ConfigurationError(f"the setting {name} is invalid: {why}", hint=hint, code="invalid-option") from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return decode_toml(text_of(path.read_bytes()))
    except OSError as error:
        raise ConfigurationError(
            f"can't read the settings {path}: {error.strerror}", code="settings-unreadable"
        ) from None
    except InvalidData as error:
        raise ConfigurationError(f"{path} is not TOML: {error}", code="settings-not-toml") from None


def _from_environment(environ: Mapping[str, str]) -> dict[str, Any]:
    """The options among the variables; lists are split by commas."""
    found: dict[str, Any] = {}
    for variable, text in environ.items():
        if variable.startswith(PREFIX) and variable not in NOT_OPTIONS:
            name = variable.removeprefix(PREFIX).lower()
            is_list = isinstance(getattr(DEFAULTS, name, None), tuple)
            found[name] = tuple(part.strip() for part in text.split(",") if part.strip()) if is_list else text
    return found


def _checked(options: dict[str, Any], *, where: str) -> dict[str, Any]:
    """The options without the retired ones. Raises `ConfigurationError`."""
    kept: dict[str, Any] = {}
    for name, value in options.items():
        if name in RETIRED:
            log.warning(
                "%s in %s has no effect: %s", name, where, RETIRED[name], extra=log_event("option-retired", option=name)
            )
        elif name in OPTIONS:
            kept[name] = value
        else:
            near = nearest(name, OPTIONS)
            hint = f"did you mean {near!r}?" if near else "`aira settings` lists the options"
            raise ConfigurationError(f"unknown option {name!r} in {where}", hint=hint, code="unknown-option")
    return kept
