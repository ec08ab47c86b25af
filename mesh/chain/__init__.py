"""The chain: accounts, names, contracts, events.

Importing this package loads aiohttp and eth_abi, which takes a third of a second: what also runs without a chain
imports it where it is needed.
"""

from __future__ import annotations

from mesh.base.extras import needs_extra

with needs_extra("chain", "the chain"):
    from mesh.chain._accounts import (
        Account,
        KeyfileError,
        copy_keyfile,
        keyfile_address,
        new_private_key,
        retire_keyfile,
        write_keyfile,
    )
    from mesh.chain._client import Chain
    from mesh.chain._contracts import ContractNames, LighthouseState
    from mesh.chain._names import namehash
    from mesh.chain._node import GWEI, FeePolicy, Node, Timing
    from mesh.chain._permits import permit_fee
    from mesh.chain._tokens import Allowances, Funding, Holding
    from mesh.chain._validators import (
        CollectedFees,
        DeployedJury,
        JuryState,
        UnsafeValidator,
    )
    from mesh.chain.answers import BlockHeader
    from mesh.chain.deploy import XRT, Deployment, DeploymentPlan, deploy
    from mesh.chain.errors import (
        ChainWentBack,
        FeeTooHigh,
        InsufficientFunds,
        InsufficientTokens,
        NoContracts,
        NodeUnreachable,
        NotALiability,
        NotOffered,
        OrderAlreadyUsed,
        RequestRefused,
        Reverted,
        TransactionTimeout,
        UnknownName,
    )
    from mesh.chain.following import (
        Approval,
        BlockEvents,
        ChainEvent,
        Finalized,
        History,
        NewLiability,
        NewLighthouse,
        Reorganisation,
        Transfer,
    )
    from mesh.chain.liabilities import Created, Dated, GasPaid, Mined, RefundState, Settled
    from mesh.chain.transactions import TransactionSender
