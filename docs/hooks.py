"""What the documentation takes from the code at build time, so that it never goes stale.

The catalogue of effects, the list of modules, and equations: TeX becomes MathML here, which browsers draw themselves.
"""

from __future__ import annotations

import html
import re
from pathlib import Path

from latex2mathml.converter import convert

from servolens.effects import (
    CATALOGUE,
    Actuator,
    Drive,
    DryFriction,
    Effect,
    Force,
    MotorForce,
    Parameter,
    Sensor,
    TimeShift,
    Transmission,
)

PACKAGE = Path(__file__).parent.parent / "src" / "servolens"
FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<kind>[(\[])(?P<tex>.*?)\\[)\]]</(?P=tag)>', flags=re.DOTALL
)
KINDS = (Actuator, TimeShift, Drive, MotorForce, Force, DryFriction, Transmission, Sensor)
TABLE_HEAD = ("| parameter | symbol | unit | range | meaning |", "|---|---|---|---|---|")
ENDLESS = 1e9


def on_page_markdown(markdown: str, /, **_: object) -> str:
    """Fill the generated parts in."""
    if "<!-- overview -->" in markdown:
        markdown = markdown.replace("<!-- overview -->", overview())
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


def overview() -> str:
    """Return a table of all effects, along the way from the command to the measured position."""
    rows = [
        f"| [`{cls.name}`](#{cls.name}) | {title(kind).lower()} | {cls.sentence} |" for kind, cls in along_the_way()
    ]
    return "\n".join(["| effect | kind | what it is |", "|---|---|---|", *rows])


def catalogue() -> str:
    """Return a section for each effect, by kind, along the way from the command to the measured position."""
    sections = {
        kind: [f"## {title(kind)}", "", (kind.__doc__ or "").splitlines()[0], ""] for kind, _ in along_the_way()
    }
    for kind, cls in along_the_way():
        sections[kind].append(effect_section(cls))
    return "\n".join(line for lines in sections.values() for line in lines)


def along_the_way() -> list[tuple[type[Effect], type[Effect]]]:
    """Return kind and class of each effect; kinds in the order in which they act, effects as in the catalogue."""
    pairs = [(kind, cls) for cls in CATALOGUE.values() for kind in KINDS if issubclass(cls, kind)]
    if len(pairs) != len(CATALOGUE):
        raise ValueError("an effect of the catalogue is of no kind that is told of here, or of two")
    return sorted(pairs, key=lambda pair: KINDS.index(pair[0]))


def title(kind: type[Effect]) -> str:
    """Return the name of a kind in words."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", kind.__name__).capitalize()


def effect_section(cls: type[Effect]) -> str:
    """Return one effect: its sentence, its formula, its parameters, and what it means to people."""
    rows = [row(spec) for spec in cls.parameters()]
    head = [f"### `{cls.name}` {{ #{cls.name} }}", "", cls.sentence, "", f"$$\n{cls.latex}\n$$", "", picture(cls), ""]
    return "\n".join([*head, *TABLE_HEAD, *rows, "", *in_words(cls), *remarks(cls)])


def picture(cls: type[Effect]) -> str:
    """Return what the effect does to a step, as `make pictures` has drawn it."""
    place = f"images/effects/{cls.name}.svg"
    if not (Path(__file__).parent / place).exists():
        raise FileNotFoundError(f"docs/{place} is missing; make pictures draws it")
    return f"![Steps of 0.1 m at kp 60 without and with {cls.name}, and the difference]({place}){{ loading=lazy }}"


def row(spec: Parameter) -> str:
    """Return one parameter as a table row, for an axis in metres that is driven by volts."""
    unit = spec.unit_for("m", "V")
    usual = "" if spec.usual is None else f"; usually {spec.usual:.4g}, not fitted unless it leaves something"
    return f"| `{spec.name}` | ${spec.symbol}$ | {unit} | {admissible(spec)} | {spec.meaning}{usual} |"


def admissible(spec: Parameter) -> str:
    """Return the range of a parameter; what is beyond all machines is no end."""
    low = None if spec.low <= -ENDLESS else f"{spec.low:.10g}"
    high = None if spec.high >= ENDLESS else f"{spec.high:.10g}"
    if low is None:
        return "any" if high is None else f"at most {high}"
    return f"{low} or more" if high is None else f"{low} to {high}"


def in_words(cls: type[Effect]) -> list[str]:
    """Return how the effect shows, what to do, and what it means for the gain."""
    told = {"Looks like": cls.looks_like, "Remedy": cls.remedy, "For the gain": cls.for_the_gain}
    return [line for head, text in told.items() if text for line in (f"**{head}.** {text}", "")]


def remarks(cls: type[Effect]) -> list[str]:
    """Return what a plant with the effect remembers, where the effect vanishes, what it has in it."""
    told = []
    if cls.states:
        told.append(f"It remembers {', '.join(f'`{state.name}`' for state in cls.states)}.")
    if cls.absent_at:
        nothing = ", ".join(f"`{name}` {at(value)}" for name, value in cls.absent_at.items())
        told.append(f"It changes nothing with {nothing}.")
    if cls.generalises:
        told.append(f"It includes {', '.join(f'[`{name}`](#{name})' for name in cls.generalises)}.")
    return [" ".join(told), ""] if told else []


def at(value: float) -> str:
    """Return a value at which an effect changes nothing."""
    return "without end" if abs(value) >= ENDLESS else f"{value:g}"


def modules() -> str:
    """Return a reference block for each public module and package of servolens."""
    names = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
    return "\n\n".join(f"::: servolens.{name}" for name in names if not name.startswith("_") and name != "cli")
