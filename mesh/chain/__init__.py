"""The chain: accounts, names, contracts, events.

Importing this package loads web3, which takes a second: what also runs without a chain imports it where it is needed.
"""

from __future__ import annotations

from mesh.chain.accounts import (
    Account,
    KeyfileError,
    SignedTransaction,
    WrongPassword,
    copy_keyfile,
    keyfile_address,
    new_private_key,
    write_keyfile,
)
from mesh.chain.client import Chain
from mesh.chain.deploy import XRT, Deployment, DeploymentPlan, deploy
from mesh.chain.errors import (
    ChainWentBack,
    FeeTooHigh,
    InsufficientFunds,
    InsufficientTokens,
    InvalidName,
    NoAccount,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    NotOffered,
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
    Offline,
    Online,
    Transfer,
)
from mesh.chain.following import BlockEvents, History, Reorganisation
from mesh.chain.liabilities import Created, RefundState, Settled
from mesh.chain.names import namehash
from mesh.chain.node import BlockHeader, Node
from mesh.chain.policy import GWEI, FeePolicy, Timing
from mesh.chain.recursion import restrain_recursion
from mesh.chain.tokens import Token
from mesh.chain.transactions import Receipt, TransactionSender
from mesh.chain.versions import LighthouseState

restrain_recursion()

__all__ = [
    "GWEI",
    "XRT",
    "Account",
    "Approval",
    "BlockEvents",
    "BlockHeader",
    "Chain",
    "ChainEvent",
    "ChainWentBack",
    "Created",
    "Current",
    "Deployment",
    "DeploymentPlan",
    "FeePolicy",
    "FeeTooHigh",
    "Finalized",
    "History",
    "InsufficientFunds",
    "InsufficientTokens",
    "InvalidName",
    "KeyfileError",
    "LighthouseState",
    "NewLiability",
    "NewLighthouse",
    "NoAccount",
    "NoContracts",
    "Node",
    "NodeUnreachable",
    "NotALiability",
    "NotOffered",
    "Offline",
    "Online",
    "Receipt",
    "RefundState",
    "Reorganisation",
    "ReorganisedTooDeep",
    "RequestRefused",
    "Reverted",
    "Settled",
    "SignedTransaction",
    "StakeTooSmall",
    "Timing",
    "Token",
    "TransactionSender",
    "TransactionTimeout",
    "Transfer",
    "UnknownName",
    "WrongChain",
    "WrongPassword",
    "copy_keyfile",
    "deploy",
    "keyfile_address",
    "namehash",
    "new_private_key",
    "write_keyfile",
]
