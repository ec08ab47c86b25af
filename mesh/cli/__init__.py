"""The command line `aira`. A command is imported only when it is called, so that small ones start fast.

Installed packages add commands by entry points of the group `aira.commands`: the name is what users type (`edge`, or
`bridge ipfs` for a command of `aira bridge`), the value is `module:command`.
"""

from __future__ import annotations

import os
import sys
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NoReturn

import click

from mesh.base.extras import PackageMissing
from mesh.errors import AiraError, ConfigurationError, InputError, nearest
from mesh.role.running import INTERRUPTED, fail

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.base.extras import EntryPoint

ENTRY_POINTS: Final = "aira.commands"
COMMANDS: Final = {
    "account": ("mesh.cli.account:command", "create, import and show accounts"),
    "chain": ("mesh.cli.chain:command", "run a development chain; deploy and inspect contracts"),
    "cid": ("mesh.cli.cid:command", "print the CIDv0 of files"),
    "demand": ("mesh.cli.demand:demand", "order a job and wait for its result"),
    "demo": ("mesh.cli.up:demo", "run one job from demand to payment in one process"),
    "doctor": ("mesh.cli.doctor:command", "find problems on this machine and suggest fixes"),
    "health": ("mesh.cli.status:health", "check a server's health (exit code)"),
    "identity": ("mesh.cli.identity:command", "create and renew the certificates of a site"),
    "liability": ("mesh.cli.liability:command", "list, show, follow, stop and cancel liabilities"),
    "lighthouse": ("mesh.cli.lighthouse:command", "list and create lighthouses; become a provider"),
    "logs": ("mesh.cli.status:logs", "show the log of an agent, provider, bridge or device"),
    "model": ("mesh.cli.model:command", "write, check and show descriptions of models"),
    "new": ("mesh.cli.new:command", "write a project of a robot, a client or a validator"),
    "objective": ("mesh.cli.objective:command", "create, show, check and fetch objectives and recordings"),
    "order": ("mesh.cli.order:command", "list and withdraw open orders"),
    "peers": ("mesh.cli.status:peers", "list the peers on a lighthouse's channel"),
    "provider": ("mesh.cli.provider:command", "match the orders of a lighthouse and settle them"),
    "quotes": ("mesh.cli.robots:quotes", "ask the robots of a model what they want for a job"),
    "replay": ("mesh.cli.replay:command", "publish the messages of a recording again"),
    "robot": ("mesh.cli.robot:command", "change how a robot works while it runs; stop and release it"),
    "robots": ("mesh.cli.robots:command", "list the robots on a lighthouse's channel"),
    "router": ("mesh.cli.router:command", "run a Zenoh router for the mesh"),
    "rpc": ("mesh.cli.rpc:command", "call a service of an agent"),
    "settings": ("mesh.cli.settings:command", "show the effective settings"),
    "signer": ("mesh.cli.signer:command", "order for programs what a policy allows; it has the key"),
    "state": ("mesh.cli.state:command", "show, back up and restore the state of agents"),
    "statement": ("mesh.cli.statement:statement", "show what an account has earned and spent, by contract and month"),
    "status": ("mesh.cli.status:status", "show the status of agents, providers and bridges"),
    "stop": ("mesh.cli.robot:stop_all", "stop the robots of this machine, or release them"),
    "up": ("mesh.cli.up:command", "run a router, a chain and a provider for development"),
    "validator": ("mesh.cli.validator:command", "judge results before they are paid; deploy a validator contract"),
    "verify": ("mesh.cli.validator:verify_recording", "check a recording against its objective and its liability"),
    "watch": ("mesh.cli.watch:command", "print what happens on a market"),
    "xrt": ("mesh.cli.xrt:command", "show, approve and transfer XRT and other tokens"),
}
"""Name → (`module:attribute` of the command, its short help). Installed packages add more by entry points."""


class LazyGroup(click.Group):
    """A group of commands of its own, of commands imported on first use, and of installed ones.

    `lazy` maps a name to the command's location (`module:attribute`) and its short help. `installed` is the prefix of
    the entry points that belong to the group: "" for the root, "bridge " for `aira bridge`, None for no entry points.
    A name in `lazy` wins over an entry point of the same name.
    """

    def __init__(
        self,
        *arguments: Any,
        lazy: Mapping[str, tuple[str, str]] | None = None,
        installed: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(*arguments, **options)
        self._lazy = dict(lazy or {})
        self._prefix = installed

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        """The installed commands of this group. Reading them takes a few ms, so this happens only when needed."""
        if self._prefix is None:
            return {}
        from mesh.base.extras import entry_points

        found = {
            name.removeprefix(self._prefix): entry
            for name, entry in entry_points(ENTRY_POINTS).items()
            if name.startswith(self._prefix)
        }
        return {name: entry for name, entry in found.items() if " " not in name}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All names, in alphabetical order."""
        return sorted({*self.commands, *self._lazy, *self._installed})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command, imported now. Exits with 2 for one that can't be imported."""
        try:
            return self._command(cmd_name)
        except ConfigurationError as error:
            fail(error)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click's, but the error for an unknown command suggests the nearest known one."""
        name = args[0] if args else ""
        if name and not name.startswith("-") and name not in self.commands and name not in self._lazy:
            known = self.list_commands(ctx)
            if name not in known:
                near = nearest(name, known)
                ctx.fail(f"no such command {name!r}" + (f"; did you mean {near!r}?" if near else ""))
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Import the command and run it. Ctrl-C during the import also exits with 130, an error with 1 or 2."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            sys.exit(INTERRUPTED)
        except click.UsageError as error:
            _fail_usage(error)
        except AiraError as error:
            fail(error)
        except OSError as error:
            if error.filename is None:
                raise

            name = os.fsdecode(error.filename)
            shown = name[:200]
            fail(InputError(f"can't use {shown}{'' if shown == name else '…'}: {error.strerror}", code="file-unusable"))

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """As click's, but wrong usage is reported as other errors are."""
        try:
            return super().make_context(info_name, args, parent, **extra)
        except click.UsageError as error:
            _fail_usage(error)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands. Imports only installed ones, whose help is not known otherwise."""
        if rows := [(name, self._help_of(name)) for name in self.list_commands(ctx)]:
            with formatter.section("Commands"):
                formatter.write_dl(rows)

    def _command(self, name: str) -> click.Command | None:
        """The command of that name. Raises `ConfigurationError`, such as `PackageMissing`."""
        if name in self.commands:
            return self.commands[name]
        if name in self._lazy:
            module, _, attribute = self._lazy[name][0].partition(":")
            command: click.Command = getattr(import_module(module), attribute)
            return command
        entry = self._installed.get(name)
        if entry is None:
            return None
        try:
            loaded = entry.load()
            if not isinstance(loaded, click.Command):
                raise TypeError(f"{entry.value} is not a click command")
        except PackageMissing:
            raise
        except Exception as error:  # whatever the import of another package raises
            raise ConfigurationError(
                f"can't load the command {name!r} of {entry.package}: {type(error).__name__}: {error}",
                hint=f"reinstall or uninstall {entry.package}; other commands still work",
                code="command-broken",
            ) from error
        return loaded

    def _help_of(self, name: str) -> str:
        if name in self._lazy:
            return self._lazy[name][1]
        try:
            command = self._command(name)
        except ConfigurationError as error:
            return str(error)
        assert command is not None
        return command.get_short_help_str(100)


def _fail_usage(error: click.UsageError) -> NoReturn:
    """Exit with 2 after one line that says what is wrong, and where to read on."""
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        raise error  # it shows the help

    message = " ".join(error.format_message().split()).removesuffix(".")
    path = error.ctx.command_path if error.ctx else "aira"
    message = message[:1].lower() + message[1:] if message[1:2].islower() else message
    fail(InputError(message, hint=f"`{path} --help` shows what it takes", code="invalid-usage"))


@click.group(cls=LazyGroup, lazy=COMMANDS, installed="", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="aira-mesh", prog_name="aira")
def main() -> None:
    """AIRA mesh: robots and people trade work without a middleman. Start with `aira demo`."""


main.add_command(
    LazyGroup(
        "bridge",
        installed="bridge ",
        help="Bridges to other networks.",
        short_help="run a bridge to another network, such as IPFS",
    )
)


@main.command("completion", short_help="print the completion script of a shell")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def _completion(shell: str) -> None:
    """Print the completion script of a shell: `eval "$(aira completion bash)"` in ~/.bashrc, the same with zsh in
    ~/.zshrc, or `aira completion fish > ~/.config/fish/completions/aira.fish`."""
    from click.shell_completion import get_completion_class

    completion = get_completion_class(shell)
    assert completion is not None
    click.echo(completion(main, {}, "aira", "_AIRA_COMPLETE").source())
