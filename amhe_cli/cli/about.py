"""`amhe help`, `examples`, `systems`, `completion`: what there is, and how to have it completed by TAB."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from amhe_cli.cli.command import Given, argument, command
from amhe_cli.cli.session import Session

#: What each bundled log is, by its name.
_EXAMPLES = {
    "pendulum": "a servo pendulum with a load: amhe identify example:pendulum takes seconds",
    "arm": "a three-joint arm of servos as a CSV: the tutorial's log, with a model to begin from",
    "arm_torque": "an arm whose joint torques were measured, and no commands; with a model",
    "pusher": "a pusher that moves a block on a table",
    "t1": "a simulated Go1 pushes a box: `make demo`",
    "t4": "the same onto another floor: amhe mhe-replay without a log takes it",
}


@command(
    "The help of a command, or of a message.",
    argument("name", required=False, metavar="[COMMAND|MESSAGE]"),
    name="help",
    simulates=False,
)
def _help(session: Session, given: Given) -> None:
    """Print the help of COMMAND, as `amhe COMMAND --help` does; without one, the list of all commands.

    MESSAGE is the word that a warning, an error or a result names: `amhe help assumed` says what it means
    and what to do. The entries are those of docs/troubleshooting.md.
    """
    from amhe_cli.cli.advice import entries
    from amhe_cli.core.errors import ConfigError, one_of

    top = click.get_current_context().find_root()
    assert isinstance(top.command, click.Group)
    found = top.command.commands.get(given.name)
    if given.name and found is None:
        about = entries()
        if given.name not in about:
            known = (*top.command.commands, *about)
            raise ConfigError(one_of("command or message", given.name, known))
        print(about[given.name])
        return
    print(found.get_help(click.Context(found, info_name=given.name, parent=top)) if found else top.get_help())


@command("The bundled logs, to try a command with.", name="examples", simulates=False)
def _examples(session: Session, given: Given) -> None:
    """List the logs that come with amhe: give them as example:NAME, in any folder."""
    from amhe_cli.core.bundled import bundled_logs, bundled_models

    logs = bundled_logs()
    if session.gave(session.record(examples={name: str(path) for name, path in logs.items()})):
        return
    for name in logs:
        print(f"example:{name:<12} {_EXAMPLES.get(name, '')}")
    print(f"models, as of amhe init: {', '.join(f'example:{name}' for name in bundled_models())}")


@command("The bundled systems: names for --system.", name="systems", simulates=False)
def _systems(session: Session, given: Given) -> None:
    """List the systems that come with amhe, and their parameters; your own is a folder with a system.yaml."""
    from textwrap import fill

    from amhe_cli.system.description.folders import bundled_systems, parameter_names

    found = {name: parameter_names(folder) for name, folder in bundled_systems().items()}
    if not session.gave(session.record(systems=found)):
        width = session.console().width
        for name, parameters in found.items():
            print(
                fill(", ".join(parameters), width, initial_indent=f"{name:<13}", subsequent_indent=13 * " ")
            )


@command(
    "A script that lets the shell complete amhe.",
    argument("shell", click.Choice(("bash", "zsh", "fish")), metavar="bash|zsh|fish"),
    name="completion",
    simulates=False,
)
def _completion(session: Session, given: Given) -> None:
    """Print the completion script of a shell.

    One line in a file of the shell switches it on: eval "$(amhe completion bash)" in ~/.bashrc.
    """
    made = get_completion_class(given.shell)
    assert made is not None
    print(made(click.get_current_context().find_root().command, {}, "amhe", "_AMHE_COMPLETE").source())


COMMANDS = (_help, _examples, _systems, _completion)
