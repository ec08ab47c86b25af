"""A chain to develop on: an EVM inside the process or anvil, with the contracts deployed, served over JSON-RPC.

This is a server; the client is `mesh.chain`.
"""

from mesh.extras import needs_extra

with needs_extra("demo", "the development chain"):
    from mesh.devchain.embedded import EmbeddedChain, ServedChain, serve_embedded
    from mesh.devchain.rpc_server import JsonRpcServer
