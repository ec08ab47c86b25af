"""The bridge to IPFS: the legacy network's PubSub channel, and its content by CID."""

from mesh.base.extras import needs_extra

with needs_extra("ipfs", "the IPFS bridge"):
    from bridges.ipfs._channel import BridgeParts, ChannelBridge
    from bridges.ipfs._relay import RelayJournal, RelayValidator
    from bridges.ipfs.daemon import Daemon, IpfsError
