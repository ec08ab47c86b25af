"""The signer: the process that has a person's key, and their policy on what programs may order with it."""
