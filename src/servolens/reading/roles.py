"""Which column of a file is which signal."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.encoder import SPAN, white_noise
from servolens.errors import InputError, as_text, by_name, names_like
from servolens.reading.files import quote
from servolens.reading.narrowing import alike, increasing, is_clock, measured, moving, near, paired
from servolens.reading.words import PACE, Meaning, allows, is_romance, meaning, unit_behind
from servolens.record import SIGNALS
from servolens.units import COMMAND_UNITS, parse_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.reading.table import Column, Table

__all__ = ["Choice", "candidates", "check_mapping", "choose", "moving_axis", "offer", "turns", "typed", "unknown"]

ALIASES = {"time": ("t",)}
ORDER = ("position", "time", "reference", "voltage", "velocity", "feedforward", "enabled")
COMMAND_KINDS = ("", "voltage", "duty", "output", "force", "torque", "current")
"""Commands in the order in which they are taken: the one nearest to the amplifier's voltage first."""
SAG = 0.1
"""Relative range below which a voltage beside other commands is a supply's: those are regulated to a few per cent."""
LOADED, TURNS = 0.3, 0.2
"""Relative range below which a voltage is that of a loaded supply where the axis turns round, by this share of its
travel: a command that turns it round does not stay so near to its mean."""
NONE, NAMED, ITS_NAME = "-", "named by you", "its name"
"""Stands for a signal that is in no column; how the column of another is known."""
MOST_SHOWN = 4
"""Columns that a question names."""
DERIVATIVE = 0.98
"""Correlation with the position's derivative from which on a column is the velocity, below half of it is not."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """A column that was taken for a signal.

    Parameters
    ----------
    column : Column
        The column.
    table : int
        Index of its table.
    address : str
        By which ``--column`` finds it again.
    meaning : Meaning
        What its heading says.
    evidence : str
        Why it was taken.
    is_stated : bool
        Whether the caller or the format's own name says it.
    """

    column: Column
    table: int
    address: str
    meaning: Meaning
    evidence: str = ""
    is_stated: bool = False

    @property
    def unit(self) -> str | None:
        """Unit that the file states."""
        return self.meaning.unit

    @property
    def label(self) -> str:
        """What people call the column: its address, and where that is a number its name too."""
        name = unit_behind(self.column.name)[0]
        return (
            f"{self.address} ({name})" if self.address.isdecimal() and name not in ("", self.address) else self.address
        )

    def because(self, evidence: str, *, is_stated: bool = False) -> Choice:
        """Return the choice with its evidence."""
        return Choice(self.column, self.table, self.address, self.meaning, evidence, is_stated)


def choose(tables: Sequence[Table], columns: Mapping[str, str] | None) -> dict[str, Choice]:
    """Return the column of each signal that a file holds.

    What the caller maps comes first, then the format's own names, then what words and symbols mean; a name that may
    mean two things is decided by what else is there and by the numbers.

    Parameters
    ----------
    tables : sequence of Table
        Of the file.
    columns : mapping, optional
        Signal to a column's name or number, or to ``-`` where it is in no column.

    Raises
    ------
    InputError
        If time or position is missing, a mapped column is missing, a needed name stands twice, or two columns may be
        the same signal: then with both readings.
    """
    mapping = check_mapping(columns, "columns", "qm")
    absent = {signal for signal, name in mapping.items() if name.strip() == NONE}
    mapping = {signal: name for signal, name in mapping.items() if signal not in absent}
    found = candidates(tables)
    chosen = {signal: _mapped(name, signal, found) for signal, name in mapping.items()}
    taken = {id(choice.column): signal for signal, choice in chosen.items()}
    for signal, mapped in chosen.items():
        if (other := taken[id(mapped.column)]) != signal:
            raise InputError(f"{signal} and {other} are both to be column {quote(mapped.label)}; name one for each")
    named = {signal: _named(signal, found) for signal in SIGNALS if signal not in {*absent, *mapping}}
    chosen |= {signal: choice for signal, choice in named.items() if choice and id(choice.column) not in taken}
    if not any(table.has_names for table in tables) and not {"time", "position"} <= set(chosen):
        raise InputError(_nameless(tables))
    for symbols in (False, True):
        for signal in ORDER:
            if signal not in (*chosen, *absent) and (choice := _pick(signal, found, chosen, symbols)):
                chosen[signal] = choice
    with moving_axis(chosen.get("position")):
        _decide(found, chosen, absent)
    if "time" not in chosen and (clock := _clock(found, chosen.get("position"))):
        chosen["time"] = clock
    _check_supply(chosen, found, mapping)
    _check_found(chosen, found)
    return {signal: chosen[signal] for signal in SIGNALS if signal in chosen}


@contextmanager
def moving_axis(position: Choice | None) -> Iterator[None]:
    """Say of an axis that never moves just that, in the place of a question: no answer makes its log useful.

    Parameters
    ----------
    position : Choice or None
        Column of the position, None where there is none.

    Raises
    ------
    InputError
        In the place of one from within, where the position is the same number throughout.
    """
    try:
        yield
    except InputError:
        values = position.column.values if position else np.empty(0)
        if position is None or values.size < 2 or not np.all(values == values[0]):
            raise
        raise InputError(
            f"column {quote(position.label)}, the position, is {0.0 + float(values[0]):g} throughout; check the"
            " sensor, log a step, or name another column, e.g. --column position=NAME"
        ) from None


def check_mapping(mapping: Mapping[str, str] | None, what: str, example: str) -> dict[str, str]:
    """Return a mapping from signals to texts, such as an `example` for the position, or refuse it.

    Raises
    ------
    InputError
        If a key is no signal or a value no text.
    """
    checked = dict(by_name(what, mapping, {"position": example}))
    for signal, text in checked.items():
        if signal not in SIGNALS:
            raise InputError(f"{what}: no signal is named {quote(signal)}; {names_like(signal, SIGNALS, 'known are')}")
        as_text(text, f"{what}: {signal}")
    return checked


def unknown(tables: Sequence[Table], chosen: Mapping[str, Choice]) -> list[Choice]:
    """Return the columns beside the position that vary, no switches, and of which no word says what they are.

    They have no unit, or one of a command.
    """
    taken = {id(choice.column) for choice in chosen.values()}
    home = chosen["position"].table
    return [
        c
        for c in candidates(tables)
        if c.table == home
        and id(c.column) not in taken
        and c.column.fault is c.column.switches is None
        and c.column.name.strip()
        and not c.meaning.words
        and np.ptp(c.column.values) > 0
        and _may_command(c.unit)
    ]


def _may_command(text: str | None) -> bool:
    unit, known = parse_unit(text or ""), [parse_unit(one) for one in COMMAND_UNITS]
    return text is None or any(unit and one and unit.dimension == one.dimension for one in known)


def offer(found: Iterable[Choice]) -> str:
    """Return which columns there are, as part of a sentence."""
    names = ", ".join(choice.label for choice in found if choice.label)
    return f"the columns are {quote(names)}" if names else "the table has no named columns"


def candidates(tables: Sequence[Table]) -> list[Choice]:
    """Return every column with what its heading says, and the shortest address that is its own.

    Parameters
    ----------
    tables : sequence of Table
        Of a file.
    """
    plain = [(i, column, unit_behind(column.name)[0]) for i, table in enumerate(tables) for column in table.columns]
    romance = any(is_romance(column.name) for _, column, _ in plain)
    everywhere = Counter(name for _, _, name in plain)
    inside = Counter((i, name) for i, _, name in plain)

    def address(number: int, table: int, name: str, column: Column) -> str:
        is_nameless = not name and column.fault is None
        if (is_nameless or inside[table, name] > 1) and str(number) not in everywhere:
            return str(number)
        return f"{tables[table].name}/{name}" if everywhere[name] > inside[table, name] else name

    return [
        Choice(column, i, address(number, i, name, column), meaning(column.name, column.unit, romance=romance))
        for number, (i, column, name) in enumerate(plain, start=1)
    ]


def _mapped(name: str, signal: str, found: Sequence[Choice]) -> Choice:
    hits = [c for c in found if name in (c.address, unit_behind(c.column.name)[0], c.column.name.strip())]
    if not hits and name.isdecimal() and 1 <= int(name) <= len(found):
        hits = [found[int(name) - 1]]
    if not hits:
        raise InputError(f"no column named {quote(name)} for {signal}; {offer(found)}")
    return _single(hits, name, signal).because(NAMED, is_stated=True)


def _named(signal: str, found: Sequence[Choice]) -> Choice | None:
    """Look for the exact name, then for it in other letters, then for an alias."""
    for wanted in (signal, *ALIASES.get(signal, ())):
        named = [(unit_behind(c.column.name)[0], c) for c in found]
        exact = [c for name, c in named if name == wanted]
        hits = exact or [c for name, c in named if name.lower() == wanted]
        if len({c.table for c in hits}) > 1:
            return None  # each table has one
        if hits:
            choice = _single(hits, wanted, signal)
            is_stated = choice.meaning.where in ("", "in brackets", "stated beside its name")
            return choice.because(ITS_NAME, is_stated=is_stated)
    return None


def _single(hits: Sequence[Choice], name: str, signal: str) -> Choice:
    if len(hits) > 1:
        which = " or ".join(f"--column {signal}={typed(hit.address)}" for hit in hits[:MOST_SHOWN])
        raise InputError(f"{len(hits)} columns are named {quote(name)}; say which, e.g. {which}")
    return hits[0]


def _pick(signal: str, found: Sequence[Choice], chosen: Mapping[str, Choice], symbols: bool) -> Choice | None:
    """Return the one column that means a signal, None without any; several are narrowed down or asked about.

    Words go before symbols, but for positions: an axis is easily mistaken for what it carries.
    """
    taken = {id(choice.column) for choice in chosen.values()}
    left = [
        c
        for c in found
        if c.meaning.roles == (signal,)
        and (c.meaning.symbol is symbols or signal == "position")
        and id(c.column) not in taken
    ]
    if signal == "time" and not symbols and not any(is_clock(c.column.values) for c in left):
        left = [c for c in found if c.meaning.roles == PACE and np.all(np.diff(c.column.values) > 0)] or left
    passed = ""
    if signal == "voltage" and left:
        left, passed = _commands(left)
    if "position" in chosen:
        left = near(left, chosen["position"])
    elif signal == "position":
        left = moving(paired(measured(left), found))
    if signal == "time":
        left = increasing(left)
        left = [c for c in left if c.meaning.words != "temps"] or left  # beside another time it is temperatures
    if not left:
        return None
    if len(left) > 1:
        left = alike(left)
    if len(left) > 1:
        raise InputError(_question(signal, left))
    choice = left[0]
    what = "the symbol" if choice.meaning.symbol else "the words" if " " in choice.meaning.words else "the word"
    return choice.because(f"{what} {quote(choice.meaning.words)}{passed}")


def _commands(left: Sequence[Choice]) -> tuple[list[Choice], str]:
    """Keep the commands of the kind that comes first, of these those that were asked for rather than measured."""
    moving = [c for c in left if not _is_supply(c)] or list(left)
    first = min(COMMAND_KINDS.index(c.meaning.kind) for c in moving)
    kept = [c for c in moving if COMMAND_KINDS.index(c.meaning.kind) == first]
    grade = min(c.meaning.grade for c in kept)
    kept = [c for c in kept if c.meaning.grade == grade]
    others = [quote(c.label) for c in left if c not in kept and len(c.column.values)]
    return kept, f"; preferred to {', '.join(others[:3])}" if others and len(kept) == 1 else ""


def _is_supply(choice: Choice) -> bool:
    """Tell whether a voltage hardly varies and never changes its sign, as a supply's."""
    values = choice.column.values
    if choice.meaning.kind != "voltage" or not values.size or not np.isfinite(values).all():
        return False
    return bool(np.ptp(values) < SAG * abs(float(np.mean(values))))


def _check_supply(chosen: Mapping[str, Choice], found: Sequence[Choice], mapping: Mapping[str, str]) -> None:
    """Ask about a voltage that hardly varies while another command does, or the axis turns round: a supply's."""
    choice = chosen.get("voltage")
    if choice is None or "voltage" in mapping or choice.meaning.kind != "voltage" or not choice.column.values.any():
        return
    if choice.column.fault is not None:
        return  # refused later
    is_guessed = choice.evidence != ITS_NAME and "position" in chosen
    goes_round = is_guessed and not _varies(choice, LOADED) and turns(chosen["position"].column.values)
    others = [c for c in found if c.meaning.roles == ("voltage",) and c.column is not choice.column and _varies(c)]
    if goes_round or (others and _is_supply(choice)):
        other = f", and {quote(others[0].address)} may be the command" if others else " while the axis turns round"
        instead = typed(others[0].address) if others else f"{NONE} if no command was logged"
        raise InputError(
            f"column {quote(choice.address)} hardly varies, as the voltage of a supply{other}; say --column"
            f" voltage={typed(choice.address)} or --column voltage={instead}"
        )


def turns(position: NDArray[np.float64]) -> bool:
    """Tell whether a position goes both ways by a fair share of its range."""
    if position.dtype.kind not in "iuf" or not position.size or not np.isfinite(position).all():
        return False  # asked about later
    up = np.max(position - np.minimum.accumulate(position))
    down = np.max(np.maximum.accumulate(position) - position)
    return bool(min(up, down) > max(TURNS * np.ptp(position), SPAN * white_noise(position)))


def _varies(choice: Choice, least: float = SAG) -> bool:
    values = choice.column.values
    return bool(values.size and np.isfinite(values).all() and np.ptp(values) > least * abs(float(np.mean(values))))


def _decide(found: Sequence[Choice], chosen: dict[str, Choice], absent: set[str]) -> None:
    """Give columns whose names mean two things the one that is left, or the one that the numbers show."""
    absent = absent | {"time"}  # what increases has been taken for it by now
    for choice in found:
        roles = choice.meaning.roles
        if len(roles) < 2 or any(choice.column is c.column for c in chosen.values()):
            continue
        if "position" in chosen and choice.table != chosen["position"].table:
            continue
        open_roles = [role for role in roles if role not in (*chosen, *absent)]
        why = f"the name {quote(choice.address)} and nothing else that could be it"
        if "velocity" in roles and "position" in chosen and "time" in chosen:
            r = _correlation(choice, chosen["position"], chosen["time"])
            if r >= DERIVATIVE:
                open_roles, why = ["velocity"], f"follows the derivative of the position (r = {r:.3f})"
            elif r < DERIVATIVE / 2:
                open_roles = [role for role in open_roles if role != "velocity"]
                why = f"the name {quote(choice.address)}, and it is not the derivative of the position (r = {r:.2f})"
        open_roles = [role for role in open_roles if role not in (*chosen, *absent)]
        if len(open_roles) > 1 and "position" not in (*chosen, *open_roles):
            continue  # the position is asked about first
        if len(open_roles) > 1:
            readings = " or ".join(f"--column {role}={typed(choice.address)}" for role in open_roles)
            raise InputError(f"column {quote(choice.address)} may be {' or '.join(open_roles)}; say {readings}")
        if open_roles:
            chosen[open_roles[0]] = choice.because(why)


def _correlation(choice: Choice, position: Choice, time: Choice) -> float:
    v, y, t = choice.column.values, position.column.values, time.column.values
    if not v.size == y.size == t.size or v.size < 3 or not all(np.isfinite(x).all() for x in (v, y, t)):
        return 1.0 if choice.table != position.table else 0.7
    width = max(v.size // 200, 1)
    steps = t[2 * width :] - t[: -2 * width]
    if np.any(steps <= 0):
        return 0.7
    slope, middle = (y[2 * width :] - y[: -2 * width]) / steps, v[width:-width]
    if np.ptp(slope) != 0 and np.ptp(middle) == 0 and middle[0] and "reference" in choice.meaning.roles:
        return 0.0  # a level that is held while the axis moves
    if np.ptp(slope) == 0 or np.ptp(middle) == 0:
        return 0.7  # nothing moves: undecided
    return abs(float(np.corrcoef(slope, middle)[0, 1]))


def _clock(found: Sequence[Choice], position: Choice | None) -> Choice | None:
    """Return the first column of the position's table that increases all along, if no name says which is the time."""
    for choice in found:
        values = choice.column.values
        if choice.meaning.roles or (position and (choice.table != position.table or choice.column is position.column)):
            continue
        if not (choice.unit and allows("time", choice.unit)):
            continue
        if values.size > 2 and np.isfinite(values).all() and np.all(np.diff(values) > 0):
            return choice.because("increases all along, and its unit is one of time")
    return None


def _question(signal: str, left: Sequence[Choice]) -> str:
    others = len(left) - len(left[:MOST_SHOWN])
    more = f" and {others} other{'s' if others > 1 else ''}" if others else ""
    readings = " or ".join(f"--column {signal}={typed(c.address)}" for c in left[:2])
    shown = ", ".join(quote(c.label) for c in left[:MOST_SHOWN])
    return f"the {signal} may be one of {shown}{more}; say which, e.g. {readings}"


def typed(name: str) -> str:
    """Return a column's name as it is to be typed after an option."""
    shown = quote(name)
    return shown if " " in name or len(name) > 40 else shown[1:-1]


def _nameless(tables: Sequence[Table]) -> str:
    columns = tables[0].columns
    starts = [float(column.values[0]) for column in columns[:6] if column.values.size]
    begins = ", ".join(f"{start:.4g}" if np.isfinite(start) else "no number" for start in starts)
    return (
        f"has no row that names its {len(columns)} columns, which begin with {begins}; name them in their order, e.g."
        " --columns time,position,voltage (- for one that is not needed)"
    )


def _clockless(missing: Sequence[str]) -> str:
    return ", or for rows at even times --setting 'sample_time=1 ms'" if "time" in missing else ""


def _check_found(chosen: Mapping[str, Choice], found: Sequence[Choice]) -> None:
    missing = [signal for signal in ("time", "position") if signal not in chosen]
    if missing:
        numbered = next((c.address for c in found if c.address != (c.label if c.column.name.strip() else "")), None)
        how = f"say which by name or number, e.g. --column {missing[0]}={numbered}"
        if numbered is None:
            how = f"say which column it is, e.g. --column {missing[0]}=NAME"
        raise InputError(
            f"no column named {' and none named '.join(missing)}; {offer(found)} ({how}{_clockless(missing)})"
        )
