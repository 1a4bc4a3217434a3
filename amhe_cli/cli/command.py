"""How a command is declared: `@command(short help, options...)` above a function of session and `Given`.

Options are values, not decorators: those that several commands share are tuples in `options`. What the user
gave is one object, `Given`, so that an option has its name in one place. Help lists options in panels.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from amhe_cli import __version__
from amhe_cli.cli.session import Session
from amhe_cli.core.errors import ConfigError

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.settings import Overrides

#: The panel of options that every command has, which help names in one line.
COMMON = "Common"
#: Names that an option had once.
FORMER = {"--for": "--seconds", "--duration": "--seconds", "--save": "--out"}


class Option(click.Option):
    """An option with its place in the help.

    Args:
        panel: Heading that it stands under.
        setting: The setting that it stands for, and wins over --set; None: it is an argument of the command.
    """

    def __init__(self, *args: Any, panel: str = "Options", setting: str | None = None, **more: Any) -> None:
        super().__init__(*args, **more)
        self.panel, self.setting = panel, setting


def option(spec: str, help: str, kind: Any = None, **more: Any) -> Option:
    """An option.

    Args:
        spec: What is typed, as help shows it: '--topic SIGNAL=/name ...' may be repeated. A word before the
            options is the name of its value: 'start --from'.
        help: What it does.
        kind: Type of its value; a tuple of texts: one of these.
        more: As of `Option` and `click.Option`.
    """
    once, repeats, _ = spec.partition(" ...")
    words = once.split(" ")
    names = max(i for i, word in enumerate(words) if word.startswith("-")) + 1
    if repeats:
        more["multiple"] = True
    if more.get("default") not in (None, ""):
        more.setdefault("show_default", True)
    choice = click.Choice(kind) if type(kind) is tuple else kind
    return Option(words[:names], help=help, type=choice, metavar=" ".join(words[names:]) or None, **more)


def flag(spec: str, help: str, **more: Any) -> Option:
    """An option without a value."""
    return option(spec, help, is_flag=True, **more)


def setting(spec: str, help: str, kind: Any = None, **more: Any) -> Option:
    """An option that stands for a setting: `mhe.update_period` is --update-period."""
    key, _, metavar = spec.partition(" ")
    name = "--" + key.rpartition(".")[2].replace("_", "-")
    return option(f"{name} {metavar}".strip(), help, kind, setting=key, **more)


def in_panel(panel: str, *options: Option) -> tuple[Option, ...]:
    """Options under one heading of the help."""
    for one in options:
        one.panel = panel
    return options


def argument(name: str, kind: Any = None, **more: Any) -> click.Argument:
    """An argument; its metavar is that of its kind unless given."""
    return click.Argument([name], type=kind, **more)


class Given(SimpleNamespace):
    """What the user gave: the value of each option and argument of a command, by its name."""

    def pick(self, *names: str) -> dict[str, Any]:
        """Some of the values, as arguments of a call."""
        return {name: getattr(self, name) for name in names}

    @property
    def overrides(self) -> Overrides:
        """Settings of --set, --config, the environment, and options that stand for one."""
        from amhe_cli.cli.settings import gathered

        return gathered(self.config, os.environ, (*self.assignments, *self.chosen))

    @property
    def inputs(self) -> Inputs:
        """Which system and which part of the logs is meant; what the command has no option for stays open."""
        from amhe_cli.cli.inputs import Inputs

        names = ("system", "topics", "msg_path", "start", "end")
        own: Any = self.pick(*(name for name in names if hasattr(self, name)))
        if hasattr(self, "config"):
            own["overrides"] = self.overrides
        return Inputs(**own)

    def reserve(self) -> Path:
        """The folder to write to; it is refused before any work is done if it cannot be written."""
        from amhe_cli.report.folder import reserve

        session = click.get_current_context().ensure_object(Session)
        session.folder = reserve(self.out, session.name, self.force)
        return session.folder

    def write_out(self, record: object, page: Callable[[], str] | None = None) -> None:
        """Write the file of --out, if any: the page, or the record where there is none or it is .json."""
        if self.out is None:
            return
        from amhe_cli.core.files import json_text, write_whole

        write_whole(self.out, json_text(record) if page is None or self.out.suffix == ".json" else page())
        if not click.get_current_context().ensure_object(Session).json:
            print(f"wrote {self.out}")

    def refuse_existing(self) -> None:
        """Refuse an --out that exists, without --force."""
        if self.out is not None and self.out.exists() and not self.force:
            raise ConfigError(
                f"{self.out}: exists; choose another name, or give `force=True` to write over it"
            )


class Command(click.Command):
    """A command that listens to the library's log from the moment its options are known."""

    #: Whether MuJoCo may have something to say in it.
    simulates = True

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options."""
        session = ctx.ensure_object(Session)
        session.name, session.command, session.options = str(self.name), ctx.command_path, options_of(self)
        parts = (arg.partition("=") for arg in from_ros(args))
        return super().parse_args(ctx, [FORMER.get(name, name) + sign + value for name, sign, value in parts])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command's body."""
        assert self.callback is not None
        session, values = ctx.ensure_object(Session), dict(ctx.params)
        session.begin(self.simulates)
        chosen: list[str] = []
        for param in self.params:
            if isinstance(param, Option) and param.setting:
                value = values.pop(str(param.name))
                if isinstance(value, dict):
                    chosen += [f"{param.setting}.{name}={one}" for name, one in value.items()]
                elif value is not None:
                    chosen.append(f"{param.setting}={value}")
        return self.callback(session, Given(**values, chosen=chosen))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, a heading for each panel of them; what all commands have is one line."""
        panels: dict[str, list[tuple[str, str]]] = {}
        common = []
        for param in self.params:
            record = param.get_help_record(ctx)
            if not isinstance(param, Option) or record is None:
                continue
            if param.panel == COMMON:
                common.append(param.opts[0])
            else:
                panels.setdefault(param.panel, []).append(record)
        widest = max((len(names) for rows in panels.values() for names, _ in rows), default=0)
        for title, rows in panels.items():
            with formatter.section(title):
                formatter.write_dl([(names.ljust(min(30, widest)), text) for names, text in rows], col_max=32)
        formatter.write_paragraph()
        formatter.write_text(f"{COMMON}: {' '.join(common)} -h, see amhe --help")


def from_ros(args: list[str]) -> list[str]:
    """Arguments with what stands between `--ros-args` and `--`, or the end, as settings.

    `-r FROM:=TO` and `-p use_sim_time:=true` have a meaning here; `ros2 launch` adds others to every node.
    """
    if "--ros-args" not in args:
        return args
    at = args.index("--ros-args")
    end = args.index("--", at) if "--" in args[at:] else len(args)
    pairs = list(zip(args[at + 1 : end], args[at + 2 : end], strict=False))
    rules = [value for name, value in pairs if name in ("-r", "--remap")]
    clock = [value.partition(":=")[2] for name, value in pairs if value.startswith("use_sim_time:=")]
    given = [f"live.remap={','.join(rules)}"] * bool(rules) + [f"live.sim_time={value}" for value in clock]
    return args[:at] + [part for one in given for part in ("--set", one)] + args[end + 1 :]


def _remember(ctx: click.Context, param: click.Parameter, value: Any) -> None:
    if value and param.name:
        setattr(ctx.ensure_object(Session), param.name, value)


def _set_limits(ctx: click.Context, param: click.Parameter, given: tuple[str, ...]) -> None:
    from amhe_cli.core.limits import limit

    if ctx.resilient_parsing:  # the line of a file that somebody wrote, or one that is completed
        return
    parts = [text.partition("=") for text in given]
    try:
        ctx.with_resource(limit(**{name: int(number) for name, _, number in parts}))
    except (ConfigError, ValueError) as error:
        raise click.BadParameter(str(error), ctx, param) from None


def _show_version(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        click.echo(f"amhe {__version__}")
        ctx.exit()


def _common(names: str, help: str, **how: Any) -> Option:
    rest: dict[str, Any] = {"is_flag": True, "callback": _remember, "expose_value": False, "panel": COMMON}
    return option(names, help, **(rest | how))


#: --json --strict -q -v --no-color --limit --version, on every command and before it.
COMMON_OPTIONS = (
    _common("--json", "Print one JSON object on stdout, the content of result.json."),
    _common("--strict", "Exit with code 3 if there was any warning."),
    _common("-q --quiet", "No progress; warnings, errors and results only."),
    _common("-v --verbose", "Say more on stderr; twice: everything.", is_flag=False, count=True),
    _common("--no-color", "No colours (NO_COLOR in the environment does the same)."),
    _common(
        "--limit NAME=N ...",
        "Set a limit on what reading a file may cost, such as topics=20000. Repeatable.",
        is_flag=False,
        is_eager=True,
        callback=_set_limits,
    ),
    _common("--version", "Show the version and exit.", is_eager=True, callback=_show_version),
)


def command(
    short: str, *params: Any, name: str | None = None, simulates: bool = True
) -> Callable[[Callable[..., Any]], Command]:
    """Make a function a command: it is called with the session and what was `Given`.

    Args:
        short: What it does, in the list of commands.
        params: Its arguments and options, or tuples of them, in the order of its help.
        name: Its name; None: that of the function.
        simulates: Whether it loads MuJoCo.
    """

    def decorate(function: Callable[..., Any]) -> Command:
        made = Command(
            name or function.__name__, callback=function, help=function.__doc__, short_help=short,
            params=list(_flat((*params, COMMON_OPTIONS))),
            context_settings={"help_option_names": ["-h", "--help"]},
        )  # fmt: skip
        made.simulates = simulates
        return made

    return decorate


def _flat(params: Any) -> Any:
    for param in params:
        if isinstance(param, tuple):
            yield from _flat(param)
        else:
            yield param


def options_of(command: click.Command) -> dict[str, str]:
    """Argument of the library -> what the user of a command types: `held_out` -> --held-out, `logs` -> LOG.

    An argument is called as its option is, or as the command's own code calls it: `start` is --from.
    """
    shown: dict[str, str] = {}
    for param in command.params:
        typed = param.opts[0]
        if not typed.startswith("-"):
            typed = getattr(param, "metavar", None) or getattr(param.type, "metavar", None) or typed.upper()
            typed = typed.strip(".[]")
        for name in (str(param.name), *(option.strip("-").replace("-", "_") for option in param.opts)):
            shown.setdefault(name, typed)
    return shown
