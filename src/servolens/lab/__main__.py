"""``python -m servolens.lab``: write a challenge for any tool, or score its answers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from servolens.errors import ServolensError
from servolens.lab.challenge import score_answers, write_challenge
from servolens.lab.worlds import WORLDS
from servolens.results import to_text

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what is asked; return the exit status."""
    given = _parser().parse_args(arguments)
    try:
        if given.command == "challenge":
            write_challenge(given.out, given.seed, given.cases, given.world)
            sys.stderr.write(f"Wrote {given.out}\n")
        else:
            score = score_answers(given.answers, given.seed, cases=given.cases, world=given.world)
            sys.stdout.write(to_text(score.to_json()))
    except ServolensError as error:
        sys.stderr.write(f"servolens.lab: error: {error}\n")
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m servolens.lab", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    challenge = commands.add_parser("challenge", help="write records of axes with hidden effects")
    challenge.add_argument("--out", type=Path, required=True, help="folder for the records, new or empty")
    score = commands.add_parser("score", help="compare answers with what was hidden")
    score.add_argument("answers", type=Path, help="JSON: case → list of effects, or effects with their parameters")
    for command, cases, told in (
        (challenge, 20, "how many (20)"),
        (score, None, "how many there are (those answered)"),
    ):
        command.add_argument("--seed", type=int, required=True, help="what the truth is drawn from")
        command.add_argument("--cases", type=int, default=cases, help=told)
        command.add_argument("--world", choices=WORLDS, default="white", help="what disturbs the measurements (white)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
