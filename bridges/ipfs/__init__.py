"""The bridge to IPFS: the legacy network's PubSub channel, and its content by CID."""

from mesh.extras import needs_extra

with needs_extra("ipfs", "the IPFS bridge"):
    from bridges.ipfs.channel import ChannelBridge
    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.errors import (
        AccessDenied,
        DaemonRefused,
        DaemonUnreachable,
        IpfsError,
        JournalFailed,
        NoPeers,
        PublishedOutOfOrder,
        PubSubDisabled,
    )
    from bridges.ipfs.journal import RelayJournal
    from bridges.ipfs.validation import RelayValidator
