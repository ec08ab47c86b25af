"""The bridge on a locked site: its role's rights suffice for both directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bridges.ipfs import BridgeParts, ChannelBridge, Daemon, RelayJournal, RelayValidator
from bridges.ipfs._relay import legacy_json
from mesh.base.background import Background
from mesh.network import Channel, MarketRules, Network
from mesh.ops.identity.roster import Member
from schemas import Offer, verify_message
from tests.support.ipfs_bridge.replays import OldDaemon
from tests.support.orders import LIGHTHOUSE, PERSON, ROBOT, demand, offer
from tests.support.sites import MARKET, Site
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

SECONDS = 60.0
BRIDGE = "0x" + "ab" * 20


async def test_a_bridge_relays_both_ways_on_a_locked_site(tmp_path: Path) -> None:
    site = Site(tmp_path)
    bridge_files = site.enlist(Member(address=BRIDGE, name="bridge", roles=("bridge",)))
    human = site.enlist(Member(address=PERSON.address, name="human", roles=("person",)))
    async with OldDaemon() as here, OldDaemon() as there:
        here.others, there.others = [there], [here]
        with site.open_router("wheel"), RelayJournal(tmp_path / "journal") as journal:
            async with (
                Network(site.client(bridge_files)) as network,
                Network(site.client(human)) as person,
                Channel(person.session, MarketRules(MARKET, address=LIGHTHOUSE)) as channel,
                channel.subscribe(Offer) as offers,
                Daemon(here.api) as daemon,
                ChannelBridge(
                    BridgeParts(
                        network=network,
                        daemon=daemon,
                        validator=RelayValidator(MarketRules(MARKET, address=LIGHTHOUSE)),
                        journal=journal,
                    ),
                    address=BRIDGE,
                ) as bridge,
                Background() as tasks,
            ):
                tasks.start(bridge.run(), "bridge of the test")
                await until(lambda: bridge.status().carries, seconds=SECONDS)

                async def is_seen() -> bool:
                    return any(key.role == "bridge" for key in await channel.present())

                await until_found(is_seen, what="the bridge's token", seconds=SECONDS)
                channel.publish(order := demand())
                await until(lambda: bridge.status().to_ipfs.carried == 1, seconds=SECONDS)
                async with Daemon(there.api) as legacy:
                    await legacy.detect_version()
                    await legacy.publish(MARKET, legacy_json(answer := offer()))
                    heard = await anext(offers)
                assert heard == verify_message(answer)
                assert heard.signer == ROBOT.address
                assert order.signature
