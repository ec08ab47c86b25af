"""`aira completion`: what a shell must read to complete the commands and options of `aira`."""

from __future__ import annotations

import click


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    """Print the completion script of a shell: `eval "$(aira completion bash)"` in ~/.bashrc, the same with zsh in
    ~/.zshrc, or `aira completion fish > ~/.config/fish/completions/aira.fish`."""
    from click.shell_completion import get_completion_class

    from mesh.cli import main

    completion = get_completion_class(shell)
    assert completion is not None
    click.echo(completion(main, {}, "aira", "_AIRA_COMPLETE").source())
