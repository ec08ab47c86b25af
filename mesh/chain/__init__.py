"""The chain: accounts, names, contracts, events.

Importing this package loads aiohttp, which takes a quarter of a second: what also runs without a chain
imports it where it is needed.
"""

from __future__ import annotations

from mesh.extras import needs_extra

with needs_extra("chain", "the chain"):
    from mesh.chain.accounts import (
        Account,
        KeyfileError,
        WrongPassword,
        copy_keyfile,
        keyfile_address,
        new_private_key,
        write_keyfile,
    )
    from mesh.chain.admission import Allowances, OrderCosts
    from mesh.chain.answers import BlockHeader
    from mesh.chain.client import Chain
    from mesh.chain.deploy import XRT, Deployment, DeploymentPlan, deploy
    from mesh.chain.errors import (
        ChainWentBack,
        FeeTooHigh,
        InsufficientFunds,
        InsufficientTokens,
        NoAccount,
        NoContracts,
        NodeUnreachable,
        NotALiability,
        NotOffered,
        OrderAlreadyUsed,
        ReorganisedTooDeep,
        RequestRefused,
        Reverted,
        StakeTooSmall,
        TransactionTimeout,
        UnknownName,
        WrongChain,
    )
    from mesh.chain.events import (
        Approval,
        ChainEvent,
        Current,
        Finalized,
        NewLiability,
        NewLighthouse,
        Online,
        Transfer,
    )
    from mesh.chain.following import BlockEvents, History, Reorganisation
    from mesh.chain.funds import Funding, Holding
    from mesh.chain.juries import CollectedFees, DeployedJury, InvalidJury, JuryState, NoFees, NotAJury
    from mesh.chain.liabilities import Created, RefundState, Settled
    from mesh.chain.lighthouse_state import LighthouseState
    from mesh.chain.names import InvalidName, namehash
    from mesh.chain.node import Node
    from mesh.chain.policy import GWEI, FeePolicy, Timing
    from mesh.chain.tokens import Token
    from mesh.chain.transactions import TransactionSender
    from mesh.chain.validators import UnsafeValidator, ValidatorWithoutCode
