"""Keys and tokens of zenoh-bridge-ros2dds, which connects robots that speak DDS.

A topic's key is its name. Tokens say what is there, but not which node has it. Messages have no attachment.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, cast

from bridges.ros2.errors import InvalidRosName, InvalidRosToken
from bridges.ros2.names import ACTION, SEND_GOAL, check_domain, check_name, full_type
from bridges.ros2.qos import DEFAULT_QOS, RosQos
from bridges.ros2.tokens import LONGEST_TOKEN, RosEntity

if TYPE_CHECKING:
    from bridges.ros2.tokens import RosEntityKind

_CODES: Final = {
    "MP": "publisher",
    "MS": "subscription",
    "SS": "server",
    "SC": "client",
    "AS": "server",
    "AC": "client",
}
_KINDS: Final = {"publisher": "MP", "subscription": "MS", "server": "SS", "client": "SC"}
_TOKEN: Final = re.compile(
    r"@/([0-9a-f]{1,32})/@ros2_lv/(?:(M[PS])/([^/]+)/([^/]+)/([^/]+)|([SA][SC])/([^/]+)/([^/]+))"
)
_QOS: Final = re.compile(r"K?:([01]?):([0-3]?):(?:([01]),(-?[0-9]{1,10}))?(?::(.*))?")
_HASH: Final = re.compile(r"typehash=([A-Za-z0-9_]{1,128});")


class Ros2Dds:
    """Keys and tokens of zenoh-bridge-ros2dds. The bridge, not the key, chooses the domain."""

    has_attachments: Final = False
    has_nodes: Final = False

    def __init__(self, domain: int) -> None:
        self.domain = check_domain(domain)
        self.selector = "@/*/@ros2_lv/**"
        """What all tokens match."""

    def key(self, name: str, kind: str, type_hash: str) -> str:
        """The key of a topic or service."""
        return name.strip("/")

    def token(self, entity: RosEntity) -> str:
        """The token of an entity; empty for a node, and for parts of actions other than the one that stands for all."""
        start = f"@/{entity.session}/@ros2_lv"
        name, kind = entity.name, entity.type
        if entity.kind == "node" or (ACTION in name and not name.endswith(f"{ACTION}send_goal")):
            return ""
        if ACTION in name:
            code = "AS" if entity.kind == "server" else "AC"
            return f"{start}/{code}/{_escaped(name.split(ACTION)[0])}/{_escaped(kind.removesuffix(SEND_GOAL))}"
        token = f"{start}/{_KINDS[entity.kind]}/{_escaped(check_name(name))}/{_escaped(full_type(kind))}"
        return token if entity.kind in ("server", "client") else f"{token}/{_encoded(entity.qos, entity.type_hash)}"

    def parse(self, token: str) -> RosEntity:
        """The entity of a token. Raises `InvalidRosToken`."""
        found = _TOKEN.fullmatch(token)
        if found is None or len(token) > LONGEST_TOKEN:
            raise InvalidRosToken(token, "it has not the parts of a token of zenoh-bridge-ros2dds")
        session, topic_code, topic, topic_type, qos, code, service, service_type = found.groups()
        code = topic_code or code
        try:
            name = check_name("/" + (topic or service).replace("§", "/"))
            kind = full_type((topic_type or service_type).replace("§", "/"))
        except InvalidRosName as error:
            raise InvalidRosToken(token, str(error)) from None
        if code in ("AS", "AC"):
            name, kind = f"{name}{ACTION}send_goal", f"{kind}{SEND_GOAL}"
        parsed, type_hash = _parsed(qos) if qos else (DEFAULT_QOS, "")
        return RosEntity(
            cast("RosEntityKind", _CODES[code]),
            self.domain,
            session,
            0,
            0,
            "",
            name=name,
            type=kind,
            type_hash=type_hash,
            qos=parsed,
        )


def _escaped(name: str) -> str:
    return name.strip("/").replace("/", "§")


def _encoded(qos: RosQos, type_hash: str) -> str:
    reliability, durability = int(qos.reliability == "reliable"), int(qos.is_transient_local)
    history = f"{int(qos.history == 'keep-all')},{qos.depth}"
    described = f":typehash={type_hash};" if type_hash.startswith("RIHS") else ""
    return f":{reliability}:{durability}:{history}{described}"


def _parsed(text: str) -> tuple[RosQos, str]:
    found = _QOS.fullmatch(text)
    if found is None:
        raise InvalidRosToken(text, "its quality of service is not as in :1:0:0,10")
    reliability, durability, history, depth, user_data = found.groups()
    described = _HASH.search(user_data or "")
    qos = RosQos(
        max(int(depth or 1), 1),
        "reliable" if reliability == "1" else "best-effort",
        "transient-local" if durability and durability != "0" else "volatile",
        "keep-all" if history == "1" else "keep-last",
    )
    return qos, described.group(1) if described else ""
