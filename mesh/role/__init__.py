"""What agent, provider, validator and bridge share: how they are composed, started, follow the chain and store."""
