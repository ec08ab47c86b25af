"""What can go wrong on the chain, by whose fault it is. Every error is one line, with a hint where one helps."""

from __future__ import annotations

from mesh.chain.refusals import HINTS
from mesh.errors import ChainError, ConfigurationError, InputError


class NodeUnreachable(ChainError):
    """No node answers at the endpoint, or what answers is no Ethereum node. Trying again later may help."""

    code = "node-unreachable"

    def __init__(self, endpoint: str, why: str) -> None:
        super().__init__(
            f"no Ethereum node answers at {endpoint} ({why})",
            hint="start a node there (`aira chain up` runs one to develop on), or name another with web3_http_provider",
        )
        self.endpoint = endpoint
        self.why = why


class WrongChain(ConfigurationError):
    """Of several nodes one is on another chain than the rest; `found` and `expected` are EIP-155 numbers."""

    code = "wrong-chain"

    def __init__(self, endpoint: str, *, found: int, expected: int) -> None:
        super().__init__(
            f"the node {endpoint} is on the chain {found}, the others are on the chain {expected}",
            hint="name nodes of one chain only",
        )
        self.endpoint = endpoint
        self.found = found
        self.expected = expected


class RequestRefused(ChainError):
    """The node answered with an error that has no better name here. `rpc_code` is JSON-RPC's."""

    code = "request-refused"

    def __init__(self, method: str, code: int, message: str) -> None:
        super().__init__(f"the node refused {method}: {message} (code {code})")
        self.method = method
        self.rpc_code = code
        self.detail = message


class NoContracts(ChainError):
    """The chain does not hold the contracts: another network, or nothing deployed yet."""

    code = "no-contracts"

    def __init__(self, what: str, chain_id: int) -> None:
        super().__init__(
            f"the chain {chain_id} has no {what}",
            hint="check web3_http_provider and ens_contract, or deploy the contracts with `aira chain deploy`",
        )
        self.what = what
        self.chain_id = chain_id


class UnknownName(ChainError):
    """An ENS name that no resolver on this chain knows."""

    code = "unknown-name"

    def __init__(self, name: str) -> None:
        super().__init__(f"the ENS name {name!r} is not known on this chain", hint="check its spelling and the network")
        self.name = name


class NotALiability(ChainError):
    """An address that the factory did not make: its terms can't be trusted."""

    code = "not-a-liability"

    def __init__(self, address: str) -> None:
        super().__init__(f"{address} is not a liability of this factory")
        self.address = address


class NotOffered(ChainError):
    """The original contracts lack something that ours have."""

    code = "not-offered"

    def __init__(self, what: str, generation: int) -> None:
        super().__init__(
            f"the original contracts of generation {generation} offer no {what}",
            hint="only a deployment of this project's contracts does",
        )
        self.what = what
        self.generation = generation


class InsufficientFunds(ChainError):
    """The account can't pay for the transaction's gas (and value). Amounts are wei."""

    code = "insufficient-funds"

    def __init__(self, address: str, *, balance: int, needed: int) -> None:
        super().__init__(
            f"{address} has {_ether(balance)}, and the transaction may need {_ether(needed)}",
            hint="send ETH to the account; gas is paid in it",
        )
        self.address = address
        self.balance = balance
        self.needed = needed


class InsufficientTokens(ChainError):
    """The account holds less of a token than it is to give. Amounts are the token's smallest unit (wn for XRT)."""

    code = "insufficient-tokens"

    def __init__(self, account: str, token: str, *, balance: int, needed: int) -> None:
        super().__init__(
            f"{account} has {balance} of the token {token}, and {needed} are needed",
            hint="send it the missing tokens, or ask for less",
        )
        self.account = account
        self.token = token
        self.balance = balance
        self.needed = needed


class StakeTooSmall(InputError):
    """A lighthouse takes no provider with less than its minimal stake. Amounts are wn."""

    code = "stake-too-small"

    def __init__(self, stake: int, minimal_stake: int) -> None:
        super().__init__(
            f"a stake of {stake} wn is below the lighthouse's minimum of {minimal_stake} wn",
            hint=f"stake {minimal_stake} wn or more: each such amount is one transaction a turn",
        )
        self.stake = stake
        self.minimal_stake = minimal_stake


class FeeTooHigh(ChainError):
    """Gas costs more than the account is ready to pay; nothing was sent. Prices are wei for a unit of gas."""

    code = "fee-too-high"

    def __init__(self, price: int, ceiling: int) -> None:
        super().__init__(
            f"gas costs {price / 10**9:g} gwei now, and the ceiling is {ceiling / 10**9:g} gwei",
            hint="try again when the price has come down, or raise the ceiling",
        )
        self.price = price
        self.ceiling = ceiling


class Reverted(ChainError):
    """A contract refused.

    `reason` is the name of its custom error (`CostMismatch`), or the text of a plain revert, `Panic`, `OutOfGas`, or
    empty when it gave none; `arguments` are the custom error's; `data` is what it reverted with. `gas_used` and `wei`
    are what that has cost: nothing, unless the transaction was mined.
    """

    code = "reverted"

    def __init__(
        self, reason: str, *, arguments: tuple[object, ...] = (), data: bytes = b"", gas_used: int = 0, wei: int = 0
    ) -> None:
        shown = ", ".join(_show(argument) for argument in arguments)
        said = f"the contract refused: {reason or 'no reason given'}" + (f" ({shown})" if shown else "")
        super().__init__(said, hint=HINTS.get(reason, ""))
        self.reason = reason
        self.arguments = arguments
        self.data = data
        self.gas_used = gas_used
        self.wei = wei


class TransactionTimeout(ChainError):
    """A sent transaction was not mined in time; it may still be. Sending the same again waits on for this one."""

    code = "transaction-timeout"

    def __init__(self, tx: str, seconds: float) -> None:
        super().__init__(
            f"the transaction {tx} was not mined within {seconds:g} s",
            hint="it may still be mined; sending the same again waits for it, and sends no second one",
        )
        self.tx = tx
        self.seconds = seconds


class ChainWentBack(ChainError):
    """The chain is shorter than what was already read of it: it was started afresh, or the node is still syncing."""

    code = "chain-went-back"

    def __init__(self, cursor: int, head: int) -> None:
        super().__init__(
            f"block {cursor} was to be read next, but the chain ends at block {head}",
            hint="wait for the node to sync; if the chain was started afresh, start with a fresh data_dir too",
        )
        self.cursor = cursor
        self.head = head


class ReorganisedTooDeep(ChainWentBack):
    """None of the blocks that are remembered of the chain is on it any more: it is another chain, or started afresh.

    `cursor` is the oldest block that is remembered.
    """

    code = "reorganised-too-deep"

    def __init__(self, cursor: int, head: int) -> None:
        ChainError.__init__(
            self,
            f"the chain has no block {cursor} as it was read, nor any read after it; it ends at block {head}",
            hint="check which chain the node is on; if it was started afresh, start with a fresh data_dir too",
        )
        self.cursor = cursor
        self.head = head


class NoAccount(ConfigurationError):
    """Something was to be signed and no account was given."""

    code = "no-account"

    def __init__(self) -> None:
        super().__init__("this needs an account", hint="set keyfile and keyfile_password_file")


class KeyfileError(ConfigurationError):
    """A keyfile or its password file can't be read or written, or is no Web3 secret storage."""

    code = "keyfile-error"

    def __init__(self, path: object, why: str, *, hint: str = "") -> None:
        super().__init__(f"{path}: {why}", hint=hint)
        self.path = str(path)


class WrongPassword(KeyfileError):
    """The password does not open the keyfile."""

    code = "wrong-password"

    def __init__(self, keyfile: object, password_file: object) -> None:
        super().__init__(
            keyfile,
            f"the password in {password_file} does not open it",
            hint="one line with the password; a line break at its end does not count",
        )


class InvalidName(InputError):
    """A text that can't be an ENS name."""

    code = "invalid-name"

    def __init__(self, text: str, why: str) -> None:
        super().__init__(f"{text[:80]!r} is not an ENS name: {why}")
        self.text = text


def _ether(wei: int) -> str:
    """An amount of wei in ETH, all its digits."""
    whole, part = divmod(wei, 10**18)
    return f"{whole}.{part:018}".rstrip("0").rstrip(".") + " ETH"


def _show(argument: object) -> str:
    return "0x" + argument.hex() if isinstance(argument, bytes) else str(argument)
