#!/bin/sh
# Configures Kubo for the bridge before the daemon starts: enables PubSub, and lets the RPC listen on the container
# network, which only the bridge shares.
set -e
ipfs config --json Pubsub.Enabled true
ipfs config Addresses.API /ip4/0.0.0.0/tcp/5001
ipfs config --json Addresses.Gateway '[]'
