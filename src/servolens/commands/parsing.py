"""Commands and options that click does not know: an example in the help, an option with several paths."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, final

import click

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Documented", "Paths", "finite", "named"]


_AMOUNT = re.compile(r"[+-]?\d+([.,]\d+)?(.*)")


def finite(value: Any) -> float:
    """Convert an option to a finite number.

    Raises
    ------
    click.BadParameter
        If it is none; with what to write where it has a decimal comma or a unit.
    """
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        found = _AMOUNT.fullmatch(str(value).strip())
        remedy = "; write it with a point and without a unit, in that of the help" if found else ""
        raise click.BadParameter(f"{str(value)[:40]!r} is not a finite number{remedy}")
    return number


@final
class Documented(click.Command):
    """A command whose epilog is an example, printed as it is to be typed."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the example on a line of its own."""
        formatter.write(f"\nExample:\n  {self.epilog}\n")

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Repeat an option of :class:`Paths` before each of its paths, then parse."""
        greedy = {name: option.taken for option in self.params if isinstance(option, Paths) for name in option.opts}
        return super().parse_args(ctx, _spread(args, greedy, ctx) if greedy else args)


@final
class Paths(click.Option):
    """An option that takes every path up to the next option, or whatever its metavar names."""

    @property
    def taken(self) -> str:
        """What it takes, in one word."""
        return (self.metavar or "RECORD").rstrip(".").lower()

    def type_cast_value(self, ctx: click.Context, value: Any) -> tuple[str, ...]:
        """Return the values; of paths, none of them empty."""
        values: tuple[str, ...] = super().type_cast_value(ctx, value)
        return named(values) if self.taken == "record" else values


def named(paths: tuple[str, ...]) -> tuple[str, ...]:
    """Return paths, none of which may be empty."""
    if not all(path.strip() for path in paths):
        raise click.UsageError("a record's file name is empty")
    return paths


def _spread(args: list[str], greedy: Mapping[str, str], ctx: click.Context) -> list[str]:
    """Return the arguments with each option of `greedy` before every one of its paths."""
    result: list[str] = []
    current, missing = None, ""
    for i, arg in enumerate(args):
        name, mark, value = arg.partition("=")
        is_option = arg.startswith("-") and arg != "-"
        if is_option and missing:
            break
        if arg == "--":
            return [*result, *args[i:]]
        if name in greedy:
            current, missing = name, "" if mark else greedy[name]
            result += [name, value] if mark else []
        elif is_option:
            current = None
            result.append(arg)
        else:
            result += [arg] if current is None else [current, arg]
            missing = ""
    if missing:
        raise click.UsageError(f"{current} needs at least one {missing}", ctx)
    return result
