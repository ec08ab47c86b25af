#!/bin/sh
# What the bridge asks of Kubo, set at each start before the daemon begins: PubSub. The RPC listens within the
# container network, which only the bridge shares.
set -e
ipfs config --json Pubsub.Enabled true
ipfs config Addresses.API /ip4/0.0.0.0/tcp/5001
ipfs config --json Addresses.Gateway '[]'
