"""The messages and services of the legacy network, generation by generation: facts, from the network's own packages.

A master of ROS 1 knows the names of types only; each connection says which version it speaks, by its MD5 sum. So all
generations can be served on one topic at the same time.
"""

from __future__ import annotations

import re
import subprocess
from functools import lru_cache
from pathlib import Path
from typing import Final

from bridges.ros1.messages import Ros1ServiceType, Ros1Type
from mesh.errors import InputError

GENERATIONS: Final = ("3", "4", "5")
"""The generations of messages: of November 2018, of December 2018, and of 2020."""

_COMMON: Final = {
    "ethereum_common/Address": "string address\n",
    "ethereum_common/UInt256": "string uint256\n",
    "robonomics_msgs/Multihash": "string multihash\n",
    "ipfs_common/Multihash": "string multihash\n",
    "ipfs_common/Filepath": "string filepath\n",
}
_TX_HASH: Final = "string txhash\n"
_TOKEN_EVENTS: Final = {
    "ethereum_common/TransferEvent": "Address args_from\nAddress args_to\nUInt256 args_value\n",
    "ethereum_common/ApprovalEvent": "Address args_owner\nAddress args_spender\nUInt256 args_value\n",
}


def _fields(text: str, *, hash: str, address: str, amount: str, number: str = "") -> str:
    """A definition from lines such as `model:hash token:address`, with the types that a generation has for them."""
    kinds = {"hash": hash, "address": address, "amount": amount, "number": number or amount, "bytes": "uint8[]"}
    split = (field.partition(":") for field in text.split())
    return "".join(f"{kinds.get(kind, kind)} {name}\n" for name, _, kind in split)


def _demand(ends: str, *, places: str = "lighthouse:address validator:address", **kinds: str) -> str:
    start = f"model:hash objective:hash token:address cost:amount {places} "
    return _fields(f"{start}validatorFee:amount deadline:amount {ends} signature:bytes", **kinds)


def _offer(ends: str, *, places: str = "validator:address lighthouse:address", **kinds: str) -> str:
    start = f"model:hash objective:hash token:address cost:amount {places} "
    return _fields(f"{start}lighthouseFee:amount deadline:amount {ends} signature:bytes", **kinds)


def _liability(text: str, **kinds: str) -> str:
    return _fields(f"address:address model:hash objective:hash {text}", **kinds)


_OCTOBER: Final = {"hash": "string", "address": "string", "amount": "uint32"}
_THREE: Final = {"hash": "robonomics_msgs/Multihash", "address": "string", "amount": "uint32"}
_FOUR: Final = {
    "hash": "ipfs_common/Multihash",
    "address": "ethereum_common/Address",
    "amount": "ethereum_common/UInt256",
}
_PARTIES: Final = "result:{} promisee:address promisor:address {}token:address cost:amount validator:address"
_RESULT: Final = "liability:address result:hash success:bool signature:bytes"

_VERSIONS: Final[dict[str, dict[str, str]]] = {
    "robonomics_liability/Liability": {
        "2018-10": _liability(
            f"{_PARTIES.format('string', '')} validatorFee:amount", **{**_OCTOBER, "amount": "uint64"}
        ),
        "2018-11": _liability(f"{_PARTIES.format('string', '')} validatorFee:amount", **{**_THREE, "amount": "uint64"}),
        "3": _liability(
            f"{_PARTIES.format('string', 'lighthouse:address ')} validatorFee:amount", **{**_THREE, "amount": "uint64"}
        ),
        "4": _liability(f"{_PARTIES.format('hash', 'lighthouse:address ')} validatorFee:amount", **_FOUR),
        "5": _liability(
            "result:hash token:address cost:amount promisee:address promisor:address lighthouse:address "
            "lighthouseFee:amount validator:address validatorFee:amount isSuccess:bool isFinalized:bool",
            **_FOUR,
        ),
    },
    "robonomics_msgs/Demand": {
        "2018-10": _demand("nonce:bytes", **_OCTOBER),
        "2018-10-22": _demand("nonce:bytes", places="validator:address", **_OCTOBER),
        "3": _demand("nonce:bytes", **_THREE),
        "4": _demand("nonce:bytes", **_FOUR),
        "2019-05": _demand("sender:address", **_FOUR),
        "5": _demand("sender:address nonce:amount", **_FOUR),
    },
    "robonomics_msgs/Offer": {
        "2018-10": _offer("nonce:bytes", **_OCTOBER),
        "2018-10-22": _offer("nonce:bytes", places="validator:address", **_OCTOBER),
        "3": _offer("nonce:bytes", **_THREE),
        "4": _offer("nonce:bytes", **_FOUR),
        "2019-05": _offer("sender:address", **_FOUR),
        "5": _offer("sender:address nonce:amount", **_FOUR),
    },
    "robonomics_msgs/Result": {
        "2018-10": _fields(_RESULT, **_OCTOBER),
        "3": _fields(_RESULT, **_THREE),
        "4": _fields(_RESULT, **_FOUR),
    },
    **{name: {"3": text} for name, text in (_COMMON | _TOKEN_EVENTS).items()},
    "ethereum_common/TxHash": {"5": _TX_HASH},
    "robonomics_msgs/AddedOrderFeedback": {
        "5": "uint8[32] order\nethereum_common/UInt256 accepted\nuint8[] signature\n"
    },
    "robonomics_msgs/AddedPendingTransactionFeedback": {"5": "ethereum_common/TxHash tx\n"},
    "std_msgs/String": {"3": "string data\n"},
    "rosgraph_msgs/Log": {
        "3": "byte DEBUG=1\nbyte INFO=2\nbyte WARN=4\nbyte ERROR=8\nbyte FATAL=16\nHeader header\nbyte level\n"
        "string name\nstring msg\nstring file\nstring function\nuint32 line\nstring[] topics\n"
    },
}

_OF_ROS: Final = ("std_msgs", "rosgraph_msgs")
"""Packages that every ROS system has."""
_NAMED: Final = {"3": "string", "5": "ethereum_common/Address"}
"""How a service names a liability."""
_DONE: Final = "bool success\nstring msg\n"


def _of_liability(more: str, reply: str) -> dict[str, str]:
    return {generation: f"{kind} address\n{more}---\n{reply}" for generation, kind in _NAMED.items()}


_SERVICES: Final[dict[str, dict[str, str]]] = {
    "robonomics_liability/StartLiability": _of_liability("", _DONE),
    "robonomics_liability/FinishLiability": _of_liability("bool success\n", ""),
    "robonomics_liability/ReadLiability": {
        "5": "ethereum_common/Address address\n---\nbool read\nLiability liability\n"
    },
    "robonomics_liability/PersistenceContainsLiability": {"4": "ethereum_common/Address address\n---\nbool exists\n"},
    "robonomics_liability/PersistenceLiabilityTimestamp": {
        "4": "ethereum_common/Address address\n---\ntime timestamp\n"
    },
    "robonomics_liability/CreateRosbagPlayer": {
        "4": "ipfs_common/Multihash ipfs_address\nstring namespace\n---\n"
        "bool success\nstring player_id\nstring error_msg\n"
    },
    "robonomics_liability/StartRosbagPlayer": {"4": f"string player_id\n---\n{_DONE}"},
    "robonomics_liability/StopRosbagPlayer": {
        "4": "string player_id\nbool success\n---\nbool success\nipfs_common/Multihash ipfs_address\n"
    },
    "ipfs_common/IpfsUploadFile": {"4": "Filepath file\n---\nbool success\nstring error_msg\nMultihash ipfs_address\n"},
    "ipfs_common/IpfsDownloadFile": {
        "4": "Multihash ipfs_address\nFilepath file\n---\nbool success\nstring error_msg\n"
    },
    "ethereum_common/Accounts": {"3": "---\nAddress[] accounts\n"},
    "ethereum_common/AccountBalance": {"3": "Address account\n---\nUInt256 balance\n"},
    "ethereum_common/Balance": {"3": "---\nUInt256 balance\n"},
    "ethereum_common/BlockNumber": {"3": "---\nuint64 number\n"},
    "ethereum_common/AccountToAddressAllowance": {"3": "Address account\nAddress to\n---\nUInt256 amount\n"},
    "ethereum_common/Allowance": {"3": "---\nUInt256 amount\n"},
    "ethereum_common/Transfer": {"3": "Address to\nUInt256 value\n---\nuint8[32] txhash\n"},
    "ethereum_common/TransferFrom": {"3": "Address owner\nAddress to\nUInt256 value\n---\nuint8[32] txhash\n"},
    "ethereum_common/Approve": {"3": "Address spender\nUInt256 value\n---\nuint8[32] txhash\n"},
}


@lru_cache(maxsize=1)
def message_types() -> dict[str, dict[str, Ros1Type]]:
    """Every version of each message, by name and MD5 sum; the last one first."""
    known = _COMMON | {"ethereum_common/TxHash": _TX_HASH}
    return {
        name: {kind.md5: kind for text in reversed(versions.values()) for kind in (Ros1Type(name, text, known),)}
        for name, versions in _VERSIONS.items()
    }


@lru_cache(maxsize=1)
def service_types() -> dict[str, dict[str, Ros1ServiceType]]:
    """Every version of each service, by name and MD5 sum; the last one first."""
    known = _COMMON | {"robonomics_liability/Liability": _VERSIONS["robonomics_liability/Liability"]["5"]}
    return {
        name: {kind.md5: kind for text in reversed(versions.values()) for kind in (Ros1ServiceType(name, text, known),)}
        for name, versions in _SERVICES.items()
    }


@lru_cache(maxsize=256)
def md5_of(name: str, generation: str) -> str:
    """The MD5 sum of a message or service in a generation, or in the first one that has it."""
    versions = _VERSIONS.get(name) or _SERVICES[name]
    known = sorted(each for each in versions if each in GENERATIONS)
    text = versions[max((each for each in known if each <= generation), default=known[0])]
    types = message_types() if name in _VERSIONS else service_types()
    return next(md5 for md5, kind in types[name].items() if kind.source == text)


def packages(generation: str) -> dict[str, dict[str, str]]:
    """The message packages of a generation: by name, the text of each file, as in `msg/Demand.msg`."""
    moved = "robonomics_msgs/Multihash" if generation >= "4" else "ipfs_common/"
    found = dict[str, dict[str, str]]()
    for folder, kinds in (("msg", _VERSIONS), ("srv", _SERVICES)):
        for name, versions in kinds.items():
            known = [each for each in versions if each in GENERATIONS and each <= generation]
            package, _, short = name.partition("/")
            if known and package not in _OF_ROS and not name.startswith(moved):
                found.setdefault(package, {})[f"{folder}/{short}.{folder}"] = versions[max(known)]
    return found


def write_workspace(folder: Path, generation: str) -> list[str]:
    """Write the message packages of a generation as a catkin workspace, and as Python where genpy is installed.

    `folder/src` is for catkin, `folder/python` for PYTHONPATH. Returns the names of the packages. Raises `InputError`.
    """
    found = packages(generation)
    try:
        for package, files in found.items():
            used = re.findall(r"(\w+)/\w+ ", "".join(files.values()))
            needed = " ".join(sorted({"std_msgs", *used} & {"std_msgs", *found} - {package}))
            lists = {
                kind: " ".join(sorted(Path(file).name for file in files if file.startswith(kind)))
                for kind in ("msg", "srv")
            }
            made = {"package.xml": _manifest(package, needed), "CMakeLists.txt": _cmake(package, needed, **lists)}
            for name, text in (files | made).items():
                path = folder / "src" / package / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        _generate_python(folder, found)
    except OSError as error:
        raise InputError(f"can't write the messages to {folder}: {error.strerror or error}") from None
    return sorted(found)


def _manifest(package: str, needed: str) -> str:
    depends = "".join(
        f"  <depend>{name}</depend>\n" for name in ["message_generation", "message_runtime", *needed.split()]
    )
    return (
        f'<?xml version="1.0"?>\n<package format="2">\n  <name>{package}</name>\n  <version>0.0.0</version>\n'
        "  <description>Messages of the AIRA network</description>\n"
        '  <maintainer email="root@localhost">AIRA mesh</maintainer>\n  <license>Apache-2.0</license>\n'
        f"  <buildtool_depend>catkin</buildtool_depend>\n{depends}</package>\n"
    )


def _cmake(package: str, needed: str, *, msg: str, srv: str) -> str:
    files = "".join(
        f"add_{kind}_files(FILES {names})\n" for kind, names in (("message", msg), ("service", srv)) if names
    )
    return (
        f"cmake_minimum_required(VERSION 2.8.3)\nproject({package})\n"
        f"find_package(catkin REQUIRED COMPONENTS message_generation {needed})\n{files}"
        f"generate_messages(DEPENDENCIES {needed})\ncatkin_package(CATKIN_DEPENDS message_runtime {needed})\n"
    )


_GENPY: Final = Path("/usr/lib/genpy"), Path("/opt/ros/noetic/lib/genpy"), Path("/opt/ros/melodic/lib/genpy")
_STD_MSGS: Final = Path("/usr/share/std_msgs/msg"), Path("/opt/ros/noetic/share/std_msgs/msg")


def _generate_python(folder: Path, found: dict[str, dict[str, str]]) -> None:
    """Make importable Python of the packages in `folder`, if genpy is installed."""
    genpy = next((each for each in _GENPY if each.is_dir()), None)
    if genpy is None:
        return
    python = "/usr/bin/python3" if genpy == _GENPY[0] else "python3"
    includes = [f"-I{name}:{folder / 'src' / name / 'msg'}" for name in found]
    includes += [f"-Istd_msgs:{each}" for each in _STD_MSGS if each.is_dir()]
    for package, files in found.items():
        for kind in ("msg", "srv"):
            texts = [str(folder / "src" / package / file) for file in sorted(files) if file.startswith(kind)]
            if not texts:
                continue
            out, tool = folder / "python" / package / kind, [python, str(genpy / f"gen{kind}_py.py"), "-p", package]
            out.mkdir(parents=True, exist_ok=True)
            (out.parent / "__init__.py").touch()
            for more in ([*includes, "-o", str(out), *texts], ["--initpy", "-o", str(out)]):
                done = subprocess.run([*tool, *more], capture_output=True, text=True, check=False)
                if done.returncode:
                    raise InputError(f"genpy can't read the messages of {package}: {done.stderr.strip()[-300:]}")
