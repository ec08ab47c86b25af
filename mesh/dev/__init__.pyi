from mesh.dev._embedded import EmbeddedChain as EmbeddedChain
from mesh.dev._rpc import JsonRpcServer as JsonRpcServer
