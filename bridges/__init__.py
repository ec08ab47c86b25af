"""Doors to other worlds: the legacy IPFS channel, devices on serial lines."""
