"""A chain to develop on: an EVM inside the process or anvil, with the contracts deployed, served over JSON-RPC.

This is a server; the client is `mesh.chain`.
"""

import os

from mesh.extras import needs_extra

# Before py-evm is imported, which hashes at import. It would spend a sixth of its time in the objects of the default.
os.environ.setdefault("ETH_HASH_BACKEND", "pysha3")

with needs_extra("demo", "the development chain"):
    from mesh.devchain.embedded import EmbeddedChain, ServedChain, serve_embedded
    from mesh.devchain.rpc_server import JsonRpcServer
