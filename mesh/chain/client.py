"""The chain as the mesh uses it: names, tokens, liabilities, lighthouses, events; one account that signs."""

from __future__ import annotations

from mesh.chain.liabilities import Liabilities
from mesh.chain.lighthouses import Lighthouses


class Chain(Liabilities, Lighthouses):
    """The contracts of the network on the chain at `endpoint` (see `Node`), for one `account` or for reading only.

    `contracts` says whether they are this project's (`"mesh"`, which read both generations of orders) or the
    originals (`"original"`) of a `generation`; the generation also names the root under which names are looked for.
    `ens` is the address of the ENS registry (empty: the public or a development chain's); `factory` and `xrt` are
    names or addresses, empty for those under that root. `timing`, `fees` and `journal` are the node's (see `Node`);
    a given node has its own.

    Amounts are ints: wei for ETH, wn for XRT, a token's smallest unit otherwise. Addresses are EIP-55; where a
    lighthouse, token or account is asked for, an ENS name does as well.

    Used with `async with`, which raises `NodeUnreachable`, `NoContracts` and `UnknownName`. Every method raises
    `NodeUnreachable` when the node is lost, but those that wait for something (`watch_…`). What sends a transaction
    waits until it is mined and raises `NoAccount`, `Reverted` (also without sending, when the simulation fails),
    `InsufficientFunds`, `TransactionTimeout`.

    What it can do is told by topic: `Tokens`, `Liabilities`, `Lighthouses`, `Following` (events), and `OpenChain`
    (names).
    """
