"""The errors of the command line. Each class has a code, which programs can rely on."""

from __future__ import annotations

from mesh.errors import AiraError, ChainError, ConfigurationError, InputError, RemoteError


class InvalidOptions(InputError):
    """Options or arguments that can't be used together, or one that is missing."""

    code = "invalid-options"


class InvalidAmount(InputError):
    """A text is not an amount of the token."""

    code = "invalid-amount"


class FileUnreadable(InputError):
    """The named file can't be read."""

    code = "file-unreadable"


class FileExists(InputError):
    """A file would be overwritten."""

    code = "file-exists"


class FolderMissing(InputError):
    """The folder of a file to write does not exist."""

    code = "folder-missing"


class FileUnwritable(ConfigurationError):
    """The operating system refuses to write a file."""

    code = "file-unwritable"


class NotAFileOrCid(InputError):
    """A text is neither the name of a file nor a CID."""

    code = "not-a-file-or-cid"


class OutputFailed(AiraError):
    """The output of a command can't be printed or written to a file."""

    code = "output-failed"


class PackageMissing(ConfigurationError):
    """A package that the command needs is not installed."""

    code = "package-missing"


class NoAnswer(RemoteError):
    """No agent, provider or bridge answers for an address."""

    code = "no-answer"


class InvalidPrivateKey(InputError):
    """A text is not a private key, or a private key was given as a file's name. The error never contains it."""

    code = "invalid-private-key"


class PasswordFileUnusable(ConfigurationError):
    """A file with a password or a key can't be read or created, or is empty."""

    code = "password-file-unusable"


class AccountMissing(ConfigurationError):
    """The command needs an address, and neither an argument nor the settings name one."""

    code = "account-missing"


class AlreadyDeployed(ConfigurationError):
    """The chain already has the contracts."""

    code = "already-deployed"


class BalanceTooLow(ChainError):
    """An account has less of a token than the command needs."""

    code = "balance-too-low"


class NotAToken(ChainError):
    """An address or name is not an ERC-20 token."""

    code = "not-a-token"


class NotALighthouse(ChainError):
    """An address is not a lighthouse of the factory."""

    code = "not-a-lighthouse"


class NameTaken(ChainError):
    """A lighthouse of that name already exists."""

    code = "name-taken"


class InvalidLighthouse(InputError):
    """The factory would reject the name or the minimal stake."""

    code = "invalid-lighthouse"


class InvalidStake(InputError):
    """The stake can't be changed by that amount."""

    code = "invalid-stake"


class NotAProvider(ChainError):
    """The account has no stake at the lighthouse."""

    code = "not-a-provider"


class LiabilityEnded(ChainError):
    """The liability is finalized, so it can't be cancelled or refunded."""

    code = "liability-ended"


class NotRefundable(ChainError):
    """The refund delay of a liability has not passed."""

    code = "not-refundable"


class NotAParty(ChainError):
    """The account is neither promisee nor promisor of the liability."""

    code = "not-a-party"


class SignatureMissing(ChainError):
    """The other party has not signed the cancellation."""

    code = "signature-missing"


class InvalidSignature(InputError):
    """A text is not a party's signature of the cancellation."""

    code = "invalid-signature"


class JobNotDone(RemoteError):
    """The promisor did not do the work; the promisee got the cost back."""

    code = "job-not-done"


class HealthUnavailable(RemoteError):
    """No server reports its health at an address."""

    code = "health-unavailable"


class InvalidServerAddress(ConfigurationError):
    """The address of a server is missing, or is not HOST:PORT."""

    code = "invalid-server-address"


class IdentityMissing(ConfigurationError):
    """The settings name no certificate."""

    code = "identity-missing"


class RosterMissing(ConfigurationError):
    """The settings name no roster."""

    code = "roster-missing"


class NothingRecorded(RemoteError):
    """No message arrived on the recorded keys."""

    code = "nothing-recorded"


class InvalidDestination(InputError):
    """A recording can't be replayed to the named keys."""

    code = "invalid-destination"


class NoRecording(InputError):
    """The liability has no recording."""

    code = "no-recording"


class UnknownTopic(InputError):
    """A recording has no topic of that name."""

    code = "unknown-topic"


class UnknownService(InputError):
    """Agents have no service of that name."""

    code = "unknown-service"


class InvalidArgument(InputError):
    """An argument of a service is unknown, missing, given twice, or of another type."""

    code = "invalid-argument"


class UnknownJob(InputError):
    """The agent has no job for that liability."""

    code = "unknown-job"


class AnvilMissing(ConfigurationError):
    """The chain needs the program anvil, which was not found."""

    code = "anvil-missing"
