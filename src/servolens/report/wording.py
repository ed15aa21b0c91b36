"""Names and symbols as plain text."""

from __future__ import annotations

import re
import unicodedata

__all__ = ["shown", "symbol_text"]

LONGEST_NAME = 40
LOWERED = str.maketrans("0123456789+-aehijklmnoprstuvx", "₀₁₂₃₄₅₆₇₈₉₊₋ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ")
"""Letters that have a small form below the line."""


def shown(name: str, longest: int = LONGEST_NAME) -> str:
    r"""Return `name` in one line of at most `longest` characters, characters that do not print replaced.

    Examples
    --------
    >>> shown("run 1\nof many"), shown("x" * 50)[-3:]
    ('run 1\ufffdof many', 'xx…')
    """
    text = "".join(c if c.isprintable() else "\ufffd" for c in name)
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def symbol_text(latex: str) -> str:
    r"""Return a symbol as plain text.

    Examples
    --------
    >>> symbol_text(r"\alpha_1"), symbol_text(r"V_\mathrm{max}"), symbol_text("k_d")
    ('α₁', 'Vₘₐₓ', 'k_d')
    """
    text = re.sub(r"\\mathrm|[{}\s]", "", latex)
    text = re.sub(r"\\([a-z]+)", _greek, text)
    return re.sub(r"_([-+\w]+)", _lowered, text)


def _lowered(match: re.Match[str]) -> str:
    """Return the letters below the line if all of them have such a form."""
    return match[1].translate(LOWERED) if all(ord(c) in LOWERED for c in match[1]) else match[0]


def _greek(match: re.Match[str]) -> str:
    try:
        return unicodedata.lookup(f"GREEK SMALL LETTER {match[1].upper()}")
    except KeyError:
        return match[1]
