"""The best of several gains: kp, kd, the derivative's filter and ki, of a cascade kp, kv, the filter and kiv.

A grid over the free gains is simulated first; where it finds gains that meet everything, CasADi's program
(:mod:`servolens.design.gains_program`) goes on from the best of them, and a finer grid around its optimum tells whether
there is a better one nearby. What the program finds is simulated by the exact sampled
loop and, where it fails there, taken back towards the gains that it began with: whatever is returned was simulated. The
program is of PD only; with an integral the finer grids alone improve on the first.

Everything has to hold in scenarios too (Calafiore and Campi, *The scenario approach to robust control design*, IEEE
Transactions on Automatic Control 51, 2006, doi:10.1109/TAC.2006.875041); the program knows those of them that settle
last. How often the gains do in others is counted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.design.gains_search import GainsSearch
from servolens.design.spec import PDSpec
from servolens.design.wishes import GainWishes
from servolens.errors import as_progress, needed
from servolens.inputs import as_models
from servolens.processors import single_threaded_blas

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design.gains_found import GainsFound
    from servolens.inputs import Plants

__all__ = ["tune_gains"]

ENOUGH = 2e-3
"""Share by which gains around an optimum have to be better than it for the program to begin anew from them."""
ROUNDS = 8
"""How often it does at most: gains around the last ones cross a decade so."""


@single_threaded_blas
def tune_gains(
    models: Plants,
    spec: PDSpec,
    wishes: GainWishes | None = None,
    *,
    progress: Callable[[str, int, int], None] | None = None,
) -> GainsFound:
    """Return the gains that meet `spec` and `wishes` on all `models` and are best by the objective.

    Optima stand at the edge of what is feasible: design the gain to use around them with :func:`servolens.recommend`.

    Parameters
    ----------
    models : Plant, model, fit, diagnosis, path of a model's file, or a sequence of these
        The axis; several must all meet everything.
    spec : PDSpec
        What to reach. Its kp and derivative filter hold where they are not free; a free kp is sought around its kp.
    wishes : GainWishes, optional
        Which gains are free, what is to be best, and what else to keep to.
    progress : callable, optional
        Is told (what, done, total).

    Raises
    ------
    InputError
        If no model is given, their units differ, or a wish cannot be judged.

    Examples
    --------
    >>> from servolens import PDSpec, Plant
    >>> axis, spec = Plant(gain=1.8, damping=6.0), PDSpec(kp=100, settling_time=0.5)
    >>> found = tune_gains(axis, spec, GainWishes(free=("kp", "kd"), objective="noise", peak_sensitivity=1.5))
    >>> found.spec.kp < spec.kp, found.verified[0].meets
    (True, True)
    """
    known, progress = as_models(models), as_progress(progress)
    wanted = GainWishes() if wishes is None else wishes
    needed(spec, PDSpec)
    needed(wanted, GainWishes)
    search = GainsSearch(known, spec, wanted)
    if search.beyond_band:
        return search.told(None, from_program=False)
    progress("Trying gains", 0, 0)
    best = of_grid = search.best(search.grid())
    search.watch(best)
    for _ in range(ROUNDS):
        progress("Solving for the gains", 0, 0)
        found = search.improved(best)
        if found is None:
            break
        around = search.best(search.around(found.gains))
        best, before = min((found, around or found), key=lambda one: one.value), found
        if best.value >= before.value * (1.0 - ENOUGH):
            break
    return search.told(best, from_program=best is not of_grid)
