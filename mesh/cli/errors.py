"""The errors of the command line. Each class has a code, which programs can rely on."""

from __future__ import annotations

from mesh.errors import AiraError, ChainError, ConfigurationError, InputError, RemoteError


class InvalidOptions(InputError, code="invalid-options"):
    """Options or arguments that can't be used together, or one that is missing."""


class InvalidUsage(InputError, code="invalid-usage"):
    """A command line that can't be understood: an unknown command or option, or a value of the wrong kind."""


class FileUnreadable(InputError, code="file-unreadable"):
    """The named file can't be read."""


class FileExists(InputError, code="file-exists"):
    """A file would be overwritten."""


class ProgramUnusable(InputError, code="program-unusable"):
    """A Python program can't be run, or has no agent (or validator), or several."""


class FolderMissing(InputError, code="folder-missing"):
    """The folder of a file to write does not exist."""


class FileUnwritable(ConfigurationError, code="file-unwritable"):
    """The operating system refuses to write a file."""


class NotAModel(InputError, code="not-a-model"):
    """A text is neither the CID nor the ENS name of a model; the hint has the CID if it is the name of a file."""


class NotAFileOrCid(InputError, code="not-a-file-or-cid"):
    """A text is neither the name of a file nor a CID."""


class OutputFailed(AiraError, code="output-failed"):
    """The output of a command can't be printed or written to a file."""


class NoAnswer(RemoteError, code="no-answer"):
    """No agent, provider or bridge answers for an address."""


class InvalidPrivateKey(InputError, code="invalid-private-key"):
    """A text is not a private key, or a private key was given as a file's name. The error never contains it."""


class PasswordFileUnusable(ConfigurationError, code="password-file-unusable"):
    """A file with a password or a key can't be read or created, or is empty."""


class AccountMissing(ConfigurationError, code="account-missing"):
    """The command needs an address, and neither an argument nor the settings name one."""


class AlreadyDeployed(ConfigurationError, code="already-deployed"):
    """The chain already has the contracts."""


class BalanceTooLow(ChainError, code="balance-too-low"):
    """An account has less of a token than the command needs."""


class NotALighthouse(ChainError, code="not-a-lighthouse"):
    """An address is not a lighthouse of the factory."""


class NameTaken(ChainError, code="name-taken"):
    """A lighthouse of that name already exists."""


class InvalidLighthouse(InputError, code="invalid-lighthouse"):
    """The factory would reject the name or the minimal stake."""


class InvalidStake(InputError, code="invalid-stake"):
    """The stake can't be changed by that amount."""


class NotAProvider(ChainError, code="not-a-provider"):
    """The account has no stake at the lighthouse."""


class LiabilityEnded(ChainError, code="liability-ended"):
    """The liability is finalized, so it can't be cancelled or refunded."""


class NotRefundable(ChainError, code="not-refundable"):
    """The refund delay of a liability has not passed."""


class NotAParty(ChainError, code="not-a-party"):
    """The account is neither promisee nor promisor of the liability."""


class SignatureMissing(ChainError, code="signature-missing"):
    """The other party has not signed the cancellation."""


class InvalidSignature(InputError, code="invalid-signature"):
    """A text is not a party's signature of the cancellation."""


class DemandExists(ConfigurationError, code="demand-exists"):
    """An equal demand is open, so that a second one may pay twice. `--existing` says what to do."""


class DoubtfulValidator(RemoteError, code="validator-doubtful"):
    """Perhaps nobody judges the work: the validator is silent, or wants more. `--yes` demands it all the same."""


class UnknownOrder(InputError, code="unknown-order"):
    """The ledger has no open order with this hash."""


class JobNotDone(RemoteError, code="job-not-done"):
    """The promisor did not do the work; the promisee got the cost back."""


class HealthUnavailable(RemoteError, code="health-unavailable"):
    """No server reports its health at an address."""


class InvalidServerAddress(ConfigurationError, code="invalid-server-address"):
    """The address of a server is missing, or is not HOST:PORT."""


class IdentityMissing(ConfigurationError, code="identity-missing"):
    """The settings name no certificate."""


class RosterMissing(ConfigurationError, code="roster-missing"):
    """The settings name no roster."""


class NothingRecorded(RemoteError, code="nothing-recorded"):
    """No message arrived on the recorded keys."""


class InvalidDestination(InputError, code="invalid-destination"):
    """A recording can't be replayed to the named keys."""


class NoRecording(InputError, code="no-recording"):
    """The liability has no recording."""


class UnknownTopic(InputError, code="unknown-topic"):
    """A recording has no topic of that name."""


class UnknownService(InputError, code="unknown-service"):
    """Agents have no service of that name."""


class InvalidArgument(InputError, code="invalid-argument"):
    """An argument of a service is unknown, missing, given twice, or of another type."""


class UnknownJob(InputError, code="unknown-job"):
    """The agent has no job for that liability."""


class AnvilMissing(ConfigurationError, code="anvil-missing"):
    """The chain needs the program anvil, which was not found."""
