"""The errors of the chain."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from mesh.amounts import ETH
from mesh.errors import ChainError, ConfigurationError
from mesh.settings.chains import profile_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.settings.chains import ChainProfile

METHOD_NOT_FOUND: Final = -32601
"""The JSON-RPC code of a method that the node does not have."""

REVERT_HINTS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "ERC20InsufficientAllowance": "approve the spender for that amount first",
        "ERC20InsufficientBalance": "send the account the missing tokens, or lower the amount",
        "ERC20InvalidReceiver": "check the address that receives the tokens",
        "FeeNotPermitted": "the fee for a permit is paid with a valid permit only; sign a new one",
        "DeadlineReached": "the order has expired; sign a new one with a later deadline",
        "OrderUsed": "an order makes at most one contract, and none once it is withdrawn; sign a new one",
        "WrongNonce": "of several orders, withdraw the one with the lowest nonce first",
        "ValidatorIsLighthouse": "name a validator that is no lighthouse, or none",
        "WrongSigner": "another account signed it, or the terms differ from those that were signed",
        "InvalidSignature": "a signature is 65 bytes with v 27 or 28 and a low s",
        "NotAProvider": "stake on the lighthouse first: only its providers may send to it",
        "NotTheKeeper": "only the account that deployed the validator collects its fees",
        "RefusedByValidator": "the validator does not accept this signer, or not these signers together",
        "SignersOutOfOrder": "several signatures are sorted by their signers' addresses, each signer once",
        "NotTheValidator": "the contract names a validator, and only that account can finalize it",
        "AlreadyFinalized": "it has ended; its record says how",
        "RefundTooEarly": "wait for that block: until then the promisor may bring a result",
        "NameTaken": "choose another name",
        "InvalidName": "a name is 1 to 32 of a to z, 0 to 9 and -; no - at its ends, nor -- after two characters",
        "InvalidStake": "the minimal stake is at least 1 wn",
        "InvalidTimeout": "the timeout is at least 1 block",
        "StakeTooSmall": "stake at least the lighthouse's minimum",
        "InsufficientStake": "no more can be withdrawn than was staked",
        "OutOfGas": "the contract's state has changed since it was asked; send it again",
    }
)
"""What to do when a contract refuses, by the name of its custom error (`Reverted.reason`)."""


class NodeUnreachable(ChainError, code="node-unreachable"):
    """No Ethereum node answers at the endpoint. Trying again later may help.

    Its code is `missing-logs` if one answers, but has no logs for a block whose header says that it may have some.
    """

    def __init__(self, endpoint: str, why: str, *, code: str = "") -> None:
        super().__init__(
            f"no Ethereum node answers at {endpoint} ({why})",
            hint="start a node there (`aira chain up` runs one to develop on), or name another with web3_http_provider",
            code=code,
        )
        self.endpoint = endpoint
        self.why = why


class RequestRefused(ChainError, code="request-refused"):
    """The node answered with an error that has no class of its own here. `rpc_code` is JSON-RPC's.

    Its code is `above-nodes-cap` if the node takes no transaction that may cost so much.
    """

    def __init__(self, method: str, rpc_code: int, detail: str, *, hint: str = "", code: str = "") -> None:
        super().__init__(f"the node refused {method}: {detail} (code {rpc_code})", hint=hint, code=code)
        self.method = method
        self.rpc_code = rpc_code
        self.detail = detail


class WrongChain(ConfigurationError, code="wrong-chain"):
    """The node is on another chain than the one that the settings name."""

    def __init__(self, endpoint: str, found: int, wanted: ChainProfile) -> None:
        known = profile_of(found)
        on = f"the chain {found}" if known is None else f"{known.title} ({found})"
        other = f" or set chain to {known.name}" if known else ""
        super().__init__(
            f"the node {endpoint} is on {on}, not on {wanted.title} ({wanted.chain_id})",
            hint=f"name a node of {wanted.title} with web3_http_provider{other}",
        )
        self.found, self.wanted = found, wanted.chain_id


class FinalityNotOffered(ChainError, code="finality-not-offered"):
    """The node does not say which block is safe, or finalized."""

    def __init__(self, endpoint: str, tag: str, why: str) -> None:
        super().__init__(
            f"the node {endpoint} does not say which block is {tag}: {why}",
            hint="name a node that does with web3_http_provider, or set finality to latest and count confirmations",
        )


class NoContracts(ChainError, code="no-contracts"):
    """The chain does not hold the contracts: another network, or nothing deployed yet."""

    def __init__(self, what: str, chain_id: int) -> None:
        super().__init__(
            f"the chain {chain_id} has no {what}",
            hint="check web3_http_provider and ens_contract, or deploy the contracts with `aira chain deploy`",
        )
        self.what = what
        self.chain_id = chain_id


class UnknownName(ChainError, code="unknown-name"):
    """An ENS name that no resolver on this chain knows."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the ENS name {name!r} is not known on this chain", hint="check its spelling and the network")
        self.name = name


class NotALiability(ChainError, code="not-a-liability"):
    """The factory did not create the contract at an address: its terms can't be trusted."""

    def __init__(self, address: str) -> None:
        super().__init__(f"{address} is not a liability of this factory")
        self.address = address


class NotOffered(ChainError, code="not-offered"):
    """The original contracts lack a function that ours have."""

    def __init__(self, what: str, generation: int) -> None:
        super().__init__(
            f"the original contracts of generation {generation} offer no {what}",
            hint="only a deployment of this project's contracts does",
        )
        self.what = what
        self.generation = generation


class OrderAlreadyUsed(ChainError, code="order-used"):
    """The order can't be withdrawn: it has become a liability, or was withdrawn before. `order` is its hash."""

    def __init__(self, order: str) -> None:
        super().__init__(
            f"the order {order} is used: it has become a contract, or was withdrawn",
            hint="look for its contract with `aira liability list`",
        )
        self.order = order


class InsufficientFunds(ChainError, code="insufficient-funds"):
    """The account can't pay for the transaction's gas (and value). Amounts are wei."""

    def __init__(self, address: str, *, balance: int, needed: int) -> None:
        super().__init__(
            f"{address} has {ETH.show(balance)}, and the transaction may need {ETH.show(needed)}",
            hint="send ETH to the account; gas is paid in it",
        )
        self.address = address
        self.balance = balance
        self.needed = needed


class InsufficientTokens(ChainError, code="insufficient-tokens"):
    """The account has less of a token than is needed. Amounts are the token's smallest unit (wn for XRT)."""

    def __init__(self, account: str, token: str, *, balance: int, needed: int) -> None:
        super().__init__(
            f"{account} has {balance} of the token {token}, and {needed} are needed",
            hint="send it the missing tokens, or ask for less",
        )
        self.account, self.token = account, token
        self.balance = balance
        self.needed = needed


class FeeTooHigh(ChainError, code="fee-too-high"):
    """Gas costs more than the ceiling; nothing was sent. Prices are wei per unit of gas."""

    def __init__(self, price: int, ceiling: int) -> None:
        super().__init__(
            f"gas costs {price / 10**9:g} gwei now, and the ceiling is {ceiling / 10**9:g} gwei",
            hint="try again when the price has come down, or raise the ceiling",
        )
        self.price = price
        self.ceiling = ceiling


class Reverted(ChainError, code="reverted"):
    """A contract reverted.

    `reason` is the name of its custom error (`CostMismatch`), or the text of a plain revert, `Panic`, `OutOfGas`, or
    empty when it gave none; `arguments` are the custom error's; `data` is what it reverted with. `gas_used` and `wei`
    are what that has cost, `block` is where, and `nonce` the transaction's number: all 0, unless it was mined.
    """

    def __init__(
        self,
        reason: str,
        *,
        arguments: tuple[object, ...] = (),
        data: bytes = b"",
        gas_used: int = 0,
        wei: int = 0,
        block: int = 0,
        nonce: int = 0,
    ) -> None:
        shown = ", ".join(_show(argument) for argument in arguments)
        said = f"the contract refused: {reason or 'no reason given'}" + (f" ({shown})" if shown else "")
        super().__init__(said, hint=REVERT_HINTS.get(reason, ""))
        self.reason = reason
        self.arguments = arguments
        self.data = data
        self.gas_used = gas_used
        self.wei = wei
        self.block = block
        self.nonce = nonce


class TransactionTimeout(ChainError, code="transaction-timeout"):
    """A sent transaction was not mined in time; it may still be. Sending the same again waits on for this one."""

    def __init__(self, tx: str, seconds: float) -> None:
        super().__init__(
            f"the transaction {tx} was not mined within {seconds:g} s",
            hint="it may still be mined; sending the same again waits for it, and sends no second one",
        )
        self.tx = tx
        self.seconds = seconds


class ChainWentBack(ChainError, code="chain-went-back"):
    """The chain is shorter than what was already read of it: it was started afresh, or the node is still syncing.

    Or it is long enough, and has no block as it was read (`reorganised-too-deep`): it is another chain, or was started
    afresh. Then waiting does not help (`is_final`), and `cursor` is the oldest block that is remembered.
    """

    def __init__(self, cursor: int, head: int, *, is_final: bool = False) -> None:
        afresh = "if the chain was started afresh, start with a fresh data_dir too"
        if is_final:
            super().__init__(
                f"the chain has no block {cursor} as it was read, nor any read after it; it ends at block {head}",
                hint=f"check which chain the node is on; {afresh}",
                code="reorganised-too-deep",
            )
        else:
            super().__init__(
                f"the next block to read is {cursor}, but the chain ends at block {head}",
                hint=f"wait for the node to sync; {afresh}",
            )
        self.cursor, self.head, self.is_final = cursor, head, is_final


def _show(argument: object) -> str:
    return "0x" + argument.hex() if isinstance(argument, bytes) else str(argument)
