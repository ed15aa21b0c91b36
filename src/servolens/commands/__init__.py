"""The commands, one function each: they read, call the library, write and tell. No logic here."""

from servolens.commands.conversion import convert
from servolens.commands.diagnosis import diagnose, next_
from servolens.commands.fleet import fleet
from servolens.commands.gains import design, map_
from servolens.commands.pages import demo, report
from servolens.commands.runs import check, identify, predict
from servolens.commands.tuning import compare, tune

__all__ = ["COMMANDS"]

COMMANDS = (demo, tune, convert, check, identify, predict, diagnose, next_, design, map_, compare, report, fleet)
"""In the order in which they are used."""
