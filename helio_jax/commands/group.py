"""The group of all commands. Each is made when it is asked for: to make all of them takes a quarter of a start.

`helio --help` reads only their names and docstrings.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from typer.core import TyperCommand, TyperGroup
from typer.main import get_command_from_info
from typer.models import CommandInfo

from helio_jax.commands.door import Command, with_common_options


class Commands(Mapping[str, Any]):
    """Commands by name, in the order in which they were registered."""

    def __init__(self) -> None:
        self._registered: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {}
        self._made: dict[str, Any] = {}

    def register(self, name: str, function: Callable[..., Any], options: dict[str, Any]) -> None:
        """Add a command: its name, its function, and typer's options of a command."""
        self._registered[name] = function, options

    def help_of(self, name: str) -> str:
        """Return the help of a command without making it."""
        return inspect.getdoc(self._registered[name][0]) or ""

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            function, options = self._registered[name]
            info = CommandInfo(name, cls=Command, callback=with_common_options(function), **options)
            self._made[name] = get_command_from_info(info, pretty_exceptions_short=True, rich_markup_mode=None)
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._registered)

    def __len__(self) -> int:
        return len(self._registered)


COMMANDS = Commands()
"""All commands of helio."""


class Group(TyperGroup):
    """The command `helio`, to which all others belong."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = COMMANDS  # type: ignore[assignment]  (no command is added to a group that is made)

    def list_commands(self, ctx: Any) -> list[str]:
        """List the names, without making a command."""
        return list(COMMANDS)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write name and first sentence of each command, without making it."""
        shown = [TyperCommand(name, help=COMMANDS.help_of(name), rich_markup_mode=None) for name in COMMANDS]
        TyperGroup(commands=shown).format_commands(ctx, formatter)
