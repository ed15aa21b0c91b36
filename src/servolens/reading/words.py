"""What a heading made of known words, symbols and units means."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, final

from servolens.reading.tokens import CLASS, PART, agree, tokens_of, without_accents
from servolens.reading.vocabulary import (
    AMOUNTS,
    ANGLES,
    ASKED_LETTERS,
    ASSUMED,
    COMMANDS,
    IMPLIED,
    LAWS,
    LETTER_KINDS,
    LETTERS,
    MEASURED_LETTERS,
    OF_ERRORS,
    ROMANCE,
    SENSORS,
    SHAPED,
    SPANS,
    UNITS,
)
from servolens.units import COMMAND_UNITS, parse_unit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = [
    "BY_ARMATURE",
    "BY_KIND",
    "BY_NAME",
    "BY_PROTOCOL",
    "DUTY",
    "PACE",
    "PERHAPS_ODRIVE",
    "Meaning",
    "allows",
    "at_the_end",
    "is_romance",
    "meaning",
    "unit_behind",
]

_ARMATURES = (("u", "a"), ("v", "a"))
BY_ARMATURE = "perhaps at the end of its name"
"""Where the unit of ``U_A`` or ``V_A`` stands: it is the armature's voltage, or a command in amperes."""
BY_NAME, DUTY, BY_KIND = "by its name", "duty", "which a column of that name is in"
BY_PROTOCOL = "which servos of that protocol count in"
BY_ODRIVE, PERHAPS_ODRIVE = "which ODrive counts in", "which ODrive counts in, as its other names beside it say"
_CONVENTIONS = (
    (
        re.compile(r".*(axis\d|odrv\d?|encoder|controller)[._](.*[._])?(pos_estimate|pos_setpoint|input_pos)"),
        "rev",
        BY_ODRIVE,
    ),
    (re.compile(r"pos_estimate|input_pos"), "rev", PERHAPS_ODRIVE),
    (re.compile(r"(.*[._])?vel_estimate"), "rev/s", BY_ODRIVE),
    (re.compile(r"servo_(stats|control|command)[._]position"), "rev", "which moteus counts in"),
    (re.compile(r"servo_(stats|control|command)[._]velocity"), "rev/s", "which moteus counts in"),
    (
        re.compile(r"(.*[._ ])?(present|goal)[_ ]position([._ ]\w+)?"),
        "counts",
        BY_PROTOCOL,
    ),
)
"""Names by which a program is known whose logs state no units, and the unit that its manual states."""
PACE = ("time", "velocity")
"""What "tempo" means: a time in Italian and Portuguese, elsewhere a speed. A time increases, which decides."""
_COMMANDS = ("voltage", "feedforward")
_ROLES = {"reference": "position", "feedforward": "voltage"}
_BRACKETS = re.compile(r"(.*?)([\[({<])([^\[\]{}<>]*)[\])}>]", re.DOTALL)
_WITHIN = re.compile(r"([^\[\]]*)\s\[([^\[\]]{2,})\]([ _].*)", re.DOTALL)
"""A unit with words behind it: ``Position [mm] filtered``; a letter there, or no blank, may be an index."""
_CLOCK = re.compile(r"(h{1,2}:m{1,2}(:s{1,2})?|m{1,2}:s{1,2})([.,:]\w+)?", re.IGNORECASE)
"""What stands in the place of a unit above time stamps."""
_SLASH = re.compile(r"(.+?)(?:/|\sin\s|,\s)([^/,]+(?:/[A-Za-z]+)?)", re.DOTALL)
LONGEST_NAME = 1000
"""Letters up to which a heading is looked at, so that no text can keep the reader busy; paths of variables have some
hundred."""
_OF_TIME = re.compile(r"\s*\([tk]\)(?=\s*(?:[\[({<].*)?$)")
"""What makes a symbol a function of time, which is no unit: ``y(t)``."""
_INDEX = re.compile(r".*\S[\[(]\d+[\])]\s*")


@final
@dataclass(frozen=True, slots=True)
class Meaning:
    """What a heading says.

    Parameters
    ----------
    roles : tuple of str
        Signals that the column may be; none if it is none, several where the name leaves it open.
    unit : str or None
        That the heading states.
    words : str
        The word or symbol that says it.
    where : str
        Where the unit stands: "in brackets", "at the end of the name", "by its name"; empty without.
    symbol : bool
        Whether a single letter is all there is.
    kind : str
        Of a command: voltage, duty, current, torque, force or output; of a position: angle or position; of what gives a
        magnitude its sign: direction; of what is left of the reference: error.
    grade : int
        Of a command: 0 what was asked for, 1 unsaid, 2 what was measured.
    rest : frozenset of str
        Words that are not understood, by which columns of one axis are told from those of another.
    """

    roles: tuple[str, ...] = ()
    unit: str | None = None
    words: str = ""
    where: str = ""
    symbol: bool = False
    kind: str = ""
    grade: int = 1
    rest: frozenset[str] = frozenset()


@cache
def meaning(text: str, unit: str | None = None, *, romance: bool = False) -> Meaning:
    """Return what the heading `text` says, with the `unit` that a row of units states.

    Parameters
    ----------
    text : str
        The heading.
    unit : str, optional
        From a row of units.
    romance : bool
        Whether another heading of the table is French, Italian or Spanish.

    Examples
    --------
    >>> meaning("Sollposition [mm]").roles, meaning("theta_deg").unit, meaning("pwm_volts").unit
    (('reference',), 'deg', 'V')
    """
    if len(text) > LONGEST_NAME:
        return Meaning()
    name, bracketed, where = unit_behind(text)
    unit = bracketed or unit
    tokens = tokens_of(name)
    kept, found = (tokens, unit) if unit else _suffix(tokens)
    tension = _of_tension(tokens, found, romance=romance or is_romance(text))
    if unit is None:
        said = _judged(name, kept, found, "at the end of its name" if found else "", tension)
        is_mark = found == "m" and ANGLES & set(kept)  # theta_m is the motor's, or measured
        if found and (is_mark or not said.roles):  # letters that are no unit of what the words say
            return _judged(name, tokens, None, "", tension)
        return said
    if not bracketed:
        where = "stated beside its name"
    return _judged(name, tokens, unit, where, tension)


def is_romance(text: str) -> bool:
    """Tell whether a heading has a word that is French, Italian or Spanish, and nothing in English or German.

    Examples
    --------
    >>> is_romance("Position de consigne [mm]"), is_romance("Posición"), is_romance("tension")
    (True, True, False)
    """
    return len(text) <= LONGEST_NAME and bool(ROMANCE & set(tokens_of(unit_behind(text)[0])))


def at_the_end(text: str) -> str | None:
    """Return the unit at the end of a heading's name, whatever stands behind that; None without, or for one letter.

    Examples
    --------
    >>> at_the_end("pos_mm [m]"), at_the_end("Position [mm]"), at_the_end("x_m [mm]")
    ('mm', None, None)
    """
    kept, found = _suffix(tokens_of(unit_behind(text)[0]))
    last = PART.findall(unit_behind(text)[0])[-1:]
    return found if kept and last and len(last[0]) > 1 else None


def allows(signal: str, unit: str) -> bool:
    """Tell whether a unit is one of a signal's.

    Examples
    --------
    >>> allows("position", "mm"), allows("position", "s"), allows("voltage", "A")
    (True, False, True)
    """
    parsed = parse_unit(unit)
    return parsed is not None and _ROLES.get(signal, signal) in _allowed(dict(parsed.dimension))


def unit_behind(text: str) -> tuple[str, str | None, str]:
    """Split a heading into its name and the unit that stands apart from it, and say where.

    Examples
    --------
    >>> unit_behind("Weg / mm"), unit_behind("y[0]"), unit_behind("y(t) [mm]")
    (('Weg', 'mm', 'behind its name'), ('y[0]', None, ''), ('y', 'mm', 'in brackets'))
    """
    text = text.strip().strip('"').strip()
    if len(text) > LONGEST_NAME:
        return text, None, ""
    text = _OF_TIME.sub("", text) if text[:1] not in "([{<" else text
    match = None if _INDEX.fullmatch(text) else _BRACKETS.fullmatch(text)
    if match and match[1]:
        inner = match[3].strip()
        is_letter = match[2] == "(" and len(inner) == 1 and inner.isupper()  # (M) may be the motor, but (V) are volts
        known = inner if is_letter and parse_unit(inner) else _known(inner)
        if match[2] == "[" or known:
            stated = None if inner in ("", "-") or _CLOCK.fullmatch(inner) else inner
            return match[1].strip(), known or stated, "in brackets"
    match = _WITHIN.fullmatch(text)
    if match and match[1].strip() and (unit := _known(match[2])) and _is_within(unit):
        return f"{match[1].strip()}{match[3]}", unit, "in brackets"
    match = _SLASH.fullmatch(text)
    if match and (unit := _known(match[2])) and (len(unit) > 1 or _is_of_signals(unit)):
        return match[1].strip(), unit, "behind its name"
    return text, None, ""


def _is_of_signals(unit: str) -> bool:
    """Tell whether signals are in such a unit: u behind ``axis/`` is no atomic mass, nor t a tonne."""
    parsed = parse_unit(unit)
    commands = (parse_unit(one) for one in COMMAND_UNITS)
    return parsed is not None and (
        _allowed(dict(parsed.dimension)) != _COMMANDS
        or any(one is not None and one.dimension == parsed.dimension for one in commands)
    )


def _is_within(unit: str) -> bool:
    """Tell whether a unit may stand within a name: one of time, position or command that is no word, as in and min."""
    is_word = unit.isdecimal() or CLASS.get(unit.lower()) in ("neutral", "other")
    return not is_word and _is_of_signals(unit) and any(allows(one, unit) for one in ("time", "position", "voltage"))


def _known(text: str) -> str | None:
    """Return the unit that a text in brackets, or behind a name, means: as pint has it, or as people write it."""
    text = text.strip()
    if text in ("", "-"):
        return None
    spoken = without_accents(text.lower()).rstrip(".").removeprefix("in ").strip()
    if parse_unit(text):
        return text if _is_of_signals(text) else UNITS.get(spoken, text)
    return UNITS.get(spoken)


def _of_tension(tokens: tuple[str, ...], unit: str | None, *, romance: bool) -> str:
    """Return what a tension is: a voltage beside Romance words, or in volts where nothing else is said of it."""
    stated, volt = parse_unit(unit or ""), parse_unit("V")
    is_plain = romance or all(token in CLASS or token in UNITS or token.isdecimal() for token in tokens)
    is_volts = stated.dimension == volt.dimension if stated and volt else romance
    return "voltage" if is_plain and is_volts else "tension"


def _suffix(tokens: tuple[str, ...]) -> tuple[tuple[str, ...], str | None]:
    """Return the tokens without the units at their end, and these."""
    if tokens[-2:] in _ARMATURES:
        return tokens, None
    if len(tokens) > 2 and tokens[-1] in ("s", "sec") and tokens[-2] in UNITS and tokens[-2] not in ("s", "ms", "us"):
        kept = tokens[:-3] if tokens[-2] == "per" else tokens[:-2]
        return kept, f"{UNITS[tokens[-2]]}/s"
    if len(tokens) > 3 and tokens[-2] == "per" and tokens[-1] in ("s", "sec", "second") and tokens[-3] in UNITS:
        return tokens[:-3], f"{UNITS[tokens[-3]]}/s"
    if len(tokens) > 1 and tokens[-1] in UNITS:
        rest = tokens[:-1] if tokens[-1] not in ("pwm", "duty", "rpm", "volt", "volts") else tokens
        return rest, UNITS[tokens[-1]]
    return tokens, None


def _convention(name: str) -> tuple[str, str] | None:
    """Return the unit that a known program's manual states for a name, and whose it is."""
    return next(((unit, whose) for form, unit, whose in _CONVENTIONS if form.fullmatch(name.lower())), None)


def _judged(name: str, tokens: tuple[str, ...], unit: str | None, where: str, tension: str) -> Meaning:
    kinds = [tension if kind == "tension" else kind for kind in _kinds(tokens)]
    rest = frozenset(token for token, kind in zip(tokens, kinds, strict=True) if kind in ("", "neutral"))
    rest -= {"value", "wert", "signal", "data", "raw", "main", "val"}
    implied = next((IMPLIED[token] for token in tokens if token in IMPLIED), None)
    if unit is None and implied:
        unit, where = implied, BY_NAME
    if len(tokens) == 1 and unit is None and allows("position", UNITS.get(tokens[0], "s")):
        return Meaning(("position",), UNITS[tokens[0]], tokens[0], BY_NAME)
    if len(tokens) == 1 and unit is None and tokens[0] in ("ms", "us", "ns", "sec", "s"):
        return Meaning(("time",), UNITS[tokens[0]], tokens[0], BY_NAME, symbol=True)
    asked, measured = "reference" in kinds, "actual" in kinds or (tokens[:1] == ("current",) and len(tokens) > 1)
    symbols = [token for token in tokens if token in LETTERS]
    spoken = [token for token, kind in zip(tokens, kinds, strict=True) if kind and kind != "neutral"]
    words = " ".join(spoken or symbols)
    roles, kind, symbol = _roles(tokens, kinds, symbols, asked=asked, measured=measured)
    if symbol and not roles:
        words = ""  # a symbol of which only its owner knows what it is
    if unit is None:
        unit, where = _convention(name) or (None, BY_ARMATURE if tokens[-2:] in _ARMATURES else "")
    if unit is None and kind in ASSUMED:
        unit, where = ASSUMED[kind], BY_KIND
    asked = asked or bool({"either", "input"} & set(kinds))
    roles = _agreeing(roles, unit, kind, asked)
    grade = 0 if asked else 2 if measured else 1
    return Meaning(roles, unit, words, where, symbol, kind, grade, rest)


def _kinds(tokens: Sequence[str]) -> list[str]:
    """Return the kind of each word; "des" is "desired" where it begins or ends a name, else a German article.

    A direction is that of another signal where one stands in the name: ``ref_dir_x`` is a reference.
    """
    kinds = [CLASS.get(token, "") for token in tokens]
    words = [i for i, token in enumerate(tokens) if not token.isdecimal()]
    for i in {words[0], words[-1]} if len(words) > 1 else ():
        if tokens[i] == "des":
            kinds[i] = "reference"
    if not agree(kinds) or "current" in tokens or any(token in LETTERS for token in tokens):
        kinds = ["" if kind == "direction" else kind for kind in kinds]
    return kinds


def _roles(
    tokens: Sequence[str], kinds: Sequence[str], symbols: Sequence[str], *, asked: bool, measured: bool
) -> tuple[tuple[str, ...], str, bool]:
    """Return the signals that words can mean, the kind of the quantity, and whether only a symbol says it."""
    if {"error", "other", "tension"} & set(kinds):
        kind = "error" if _is_error_of_position(tokens, kinds) else ""
        return (), kind, not {"error", "other"} & set(kinds)  # of a tension only its owner knows what it is
    if "feedforward" in kinds or "enabled" in kinds:
        return ("feedforward" if "feedforward" in kinds else "enabled",), "", False
    if _ends_with_time(tokens, kinds):
        return _bare(tokens, kinds, symbols, measured=False)
    asked = asked or bool({"either", "input"} & set(kinds)) or _is_shaped(tokens, kinds)
    command = next((kind for kind in COMMANDS if kind in kinds), "")
    if command == "output" and LAWS & set(tokens):
        return ("voltage",), command, False
    is_place = bool({"angle", "position"} & set(kinds))
    if {"velocity", "pace"} & set(kinds) or (is_place and "dot" in tokens):
        return (() if asked else _of_speed(tokens, kinds)), "", False
    if "direction" in kinds:
        return (), "direction", False
    if command in ("voltage", "output") and SENSORS & set(tokens):
        return (), "", False
    if is_place:
        return _of_place(tokens, kinds, command, asked=asked)
    if command or "current" in tokens:
        return ("voltage",), command or "current", False
    return _bare(tokens, kinds, symbols, measured=measured)


def _of_speed(tokens: Sequence[str], kinds: Sequence[str]) -> tuple[str, ...]:
    if "pace" not in kinds:
        return ("velocity",)
    return () if SPANS & set(tokens) else PACE


def _is_error_of_position(tokens: Sequence[str], kinds: Sequence[str]) -> bool:
    """Tell whether there is a word for an error, and nothing beside it says that it is not the position loop's."""
    if "error" not in kinds or {"enc", "encoder", *SENSORS} & set(tokens):
        return False
    return all(
        kind in ("error", "position", "angle", "neutral") or token in OF_ERRORS or token.isdecimal()
        for token, kind in zip(tokens, kinds, strict=True)
    )


def _of_place(
    tokens: Sequence[str], kinds: Sequence[str], command: str, *, asked: bool
) -> tuple[tuple[str, ...], str, bool]:
    """Return what a name with a word for a position or an angle means: a position, or where it is asked for."""
    if tokens[0] == "in":  # whether it is in position
        return (), "", False
    is_angle = "angle" in kinds or bool({"joint", "joints", "gelenk"} & set(tokens))
    roles = ("reference",) if asked else ("position",)
    return (() if command and command != "output" else roles), "angle" if is_angle else "position", False


def _ends_with_time(tokens: Sequence[str], kinds: Sequence[str]) -> bool:
    """Tell whether a name's last word is one for time: ``u.Time`` is that of the voltage."""
    last = max((i for i, token in enumerate(tokens) if not token.isdecimal()), default=0)
    return bool(tokens) and kinds[last] == "time" and tokens[last] != "t"


def _is_shaped(tokens: Sequence[str], kinds: Sequence[str]) -> bool:
    """Tell whether a position or a velocity is what a path generator or a loop asks for: ``control.position``."""
    pairs = zip(tokens[:-1], kinds[1:], strict=True)
    return bool(SHAPED & set(tokens)) or any(
        token == "control" and kind in ("position", "angle", "velocity") for token, kind in pairs
    )


def _bare(
    tokens: Sequence[str], kinds: Sequence[str], symbols: Sequence[str], *, measured: bool
) -> tuple[tuple[str, ...], str, bool]:
    """Return what a name without a quantity means: a time, a modifier such as "target", or a symbol."""
    asked = bool({"reference", "either"} & set(kinds))
    if "time" in kinds:
        takes = bool(SPANS & set(tokens)) or ("t" in tokens and (measured or asked))
        return (() if takes else ("time",)), "", False
    if AMOUNTS & set(tokens):
        return (), "", True
    letter = next((token for token in tokens if token in MEASURED_LETTERS), "")
    if letter and (measured or asked) and not {"x", "y", "z", "q"} & set(tokens):
        roles = (ASKED_LETTERS if asked else MEASURED_LETTERS)[letter]
        return roles, "current" if letter == "i" else "", len(roles) != 1
    if "input" in kinds:
        return ("position", "reference", "voltage"), "", False
    if "either" in kinds:
        return ("reference", "voltage"), "", False
    kind = "angle" if ANGLES & set(symbols) else ""
    if "reference" in kinds:
        return ("reference",), kind, False
    if measured:
        return ("position",), kind, False
    if symbols:
        return LETTERS[symbols[0]], LETTER_KINDS.get(symbols[0], kind), True
    return (), "", False


def _agreeing(roles: tuple[str, ...], unit: str | None, kind: str, asked: bool) -> tuple[str, ...]:
    """Keep the roles that a unit allows; where no word says one, the unit does."""
    parsed = parse_unit(unit) if unit else None
    if parsed is None:
        return roles
    allowed = _allowed(dict(parsed.dimension))
    if roles == ("reference",) and not kind and allowed == ("voltage",):
        return ("voltage",)
    if not roles and not kind:
        return ("reference",) if asked and "position" in allowed else ()
    return tuple(role for role in roles if role in allowed or (role == "reference" and "position" in allowed))


def _allowed(dimension: Mapping[str, float]) -> tuple[str, ...]:
    plain = dict(dimension)
    if plain == {"s": 1}:
        return ("time",)
    if plain in ({"m": 1}, {"rad": 1}, {"count": 1}):
        return ("position",)
    if plain in ({"m": 1, "s": -1}, {"rad": 1, "s": -1}, {"count": 1, "s": -1}):
        return ("velocity",)
    if plain == {}:
        return ("time", "position", "reference", "velocity", "voltage", "feedforward", "enabled")
    return _COMMANDS
