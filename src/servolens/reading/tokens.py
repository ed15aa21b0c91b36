"""Words of which a heading is made: split at signs, at capitals, and compounds at the words that are known."""

from __future__ import annotations

import re
import unicodedata
from functools import cache
from typing import TYPE_CHECKING

from servolens.reading.vocabulary import LETTERS, MOTOR_VOLTAGES, PLACES, UNITS, WORDS

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["CLASS", "PART", "agree", "tokens_of", "without_accents"]

CLASS = {word: kind for kind, words in WORDS.items() for word in words.split()}
"""Kind of each word that is known."""
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
_TOKEN = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+|\d+")
PART = re.compile(r"[A-Za-zäöüÄÖÜß]+|\d+")
"""Letters or digits in a row."""


def tokens_of(name: str) -> tuple[str, ...]:
    """Split a name at signs, at capitals, and compounds at the words that are known.

    Examples
    --------
    >>> tokens_of("Sollposition"), tokens_of("axis1.ActPos"), tokens_of("Posición_mm")
    (('soll', 'position'), ('axis', '1', 'act', 'pos'), ('posicion', 'mm'))
    """
    found: list[str] = []
    for part in PART.findall(
        without_accents(name)
        .replace("Δ", "delta ")
        .replace("%", " percent ")
        .replace("θ", "theta ")
        .replace("φ", "phi ")
    ):
        whole = part.lower().translate(_UMLAUTS)
        if whole in CLASS or whole in LETTERS or whole in UNITS:
            found.append(whole)
            continue
        for token in _TOKEN.findall(part):
            plain = token.lower().translate(_UMLAUTS)
            found += _compound(plain) or _marked(plain) or _a_voltage(plain) or [plain]
    for i in range(len(found) - 1, 0, -1):
        if found[i] == "d" and found[i - 1] + "d" in LETTERS:  # q_d is qd
            found[i - 1 : i + 1] = [found[i - 1] + "d"]
    return tuple(found)


def without_accents(name: str) -> str:
    """Return a name with plain letters in the place of those with accents; German ones stay."""
    if name.isascii():
        return name
    letters = unicodedata.normalize("NFC", name)
    return "".join(c if c in "äöüÄÖÜß" else unicodedata.normalize("NFD", c)[0] for c in letters)


def _marked(token: str) -> list[str] | None:
    """Return the symbol of a position and what stands behind it: ``xref``, ``thetasoll``."""
    for symbol in PLACES:
        mark = token.removeprefix(symbol)
        if mark != token and (mark == "des" or CLASS.get(mark) in ("reference", "actual")):
            return [symbol, mark]
    return None


def _a_voltage(token: str) -> list[str] | None:
    """Return which voltage of the motor a German compound names: ``Ankerspannung``; others are sensors' or tensions."""
    head = token.removesuffix("spannung")
    return [head, "spannung"] if head != token and head in MOTOR_VOLTAGES else None


@cache
def _compound(token: str) -> list[str] | None:
    """Return the known words that a compound is made of, longest first, or None if it is made of others."""
    if token in CLASS:
        return [token]
    for end in range(len(token) - 2, 2, -1):
        head = token[:end]
        if head not in CLASS:
            continue
        for rest in (token[end:], token[end + 1 :] if token[end] == "s" else ""):
            tail = _compound(rest) if len(rest) > 1 else None
            if tail and agree(CLASS[word] for word in (head, *tail)):
                return [head, *tail]
    return None


def agree(kinds: Iterable[str]) -> bool:
    """Tell whether words can stand together: a direction is one of its own only beside words that say nothing else."""
    return "direction" not in (found := set(kinds)) or found <= {"direction", "neutral", "actual", ""}
