"""What the documentation takes from the code at build time, so that it never goes stale.

The catalogue of effects, the list of modules, and equations: TeX becomes MathML here, which browsers draw themselves.
"""

from __future__ import annotations

import html
import re
from pathlib import Path

from latex2mathml.converter import convert

from servolens.effects import CATALOGUE, Effect

PACKAGE = Path(__file__).parent.parent / "src" / "servolens"
FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<kind>[(\[])(?P<tex>.*?)\\[)\]]</(?P=tag)>', flags=re.DOTALL
)
TABLE_HEAD = ("| parameter | symbol | unit | meaning |", "|---|---|---|---|")


def on_page_markdown(markdown: str, /, **_: object) -> str:
    """Fill the generated parts in."""
    if "<!-- effects -->" in markdown:
        markdown = markdown.replace("<!-- effects -->", catalogue())
    if "<!-- modules -->" in markdown:
        markdown = markdown.replace("<!-- modules -->", modules())
    return markdown


def on_page_content(content: str, /, **_: object) -> str:
    """Turn every formula into MathML."""
    return FORMULA.sub(formula, content)


def formula(match: re.Match[str]) -> str:
    """Return the MathML of one formula."""
    display = "block" if match["kind"] == "[" else "inline"
    return convert(html.unescape(match["tex"]).strip(), display=display)


def catalogue() -> str:
    """Return a section for each effect, by kind, in the order of the catalogue."""
    kinds = {cls.__mro__[1] for cls in CATALOGUE.values()}
    return "\n".join(kind_section(kind) for kind in sorted(kinds, key=lambda kind: kind.__name__))


def kind_section(kind: type[Effect]) -> str:
    """Return the effects of one kind, under what the kind is."""
    effects = [cls for cls in CATALOGUE.values() if cls.__mro__[1] is kind]
    title = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", kind.__name__).capitalize()
    sentence = (kind.__doc__ or "").splitlines()[0]
    return "\n".join([f"## {title}", "", sentence, "", *(effect_section(cls) for cls in effects)])


def effect_section(cls: type[Effect]) -> str:
    """Return one effect: its sentence, its formula, its parameters."""
    rows = [row(spec.name, spec.symbol, spec.unit, spec.meaning) for spec in cls.parameters()]
    head = [f"### `{cls.name}`", "", cls.sentence, "", f"$$\n{cls.latex}\n$$", ""]
    return "\n".join([*head, *TABLE_HEAD, *rows, ""])


def row(name: str, symbol: str, unit: str, meaning: str) -> str:
    """Return one parameter as a table row, for an axis in metres that is driven by volts."""
    return f"| `{name}` | ${symbol}$ | {unit.format(x='m', u='V')} | {meaning} |"


def modules() -> str:
    """Return a reference block for each public module and package of servolens."""
    names = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
    return "\n\n".join(f"::: servolens.{name}" for name in names if not name.startswith("_") and name != "cli")
