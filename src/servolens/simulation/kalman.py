"""The gains of an observer, sample by sample, compiled with the stepping rule.

What an observer of an axis errs by is about a linear system: position, velocity (which the damping lets decay) and a
low-pass acceleration that shakes the axis. Where the sampling instants move unseen, by δ with the standard deviation s,
a reading errs by v·δ; and the voltage, which changes by Δu at that instant, changes the velocity by −β·Δu·δ: one error
that both reading and motion show. The rule is Kalman's for such correlated errors.

References
----------
.. [1] R. E. Kalman, A new approach to linear filtering and prediction problems, Journal of Basic Engineering 82 (1960),
   doi:10.1115/1.3662552.
.. [2] B. D. O. Anderson and J. B. Moore, Optimal Filtering, 1979, section 5.5: noise of process and sensor correlated.
"""

from __future__ import annotations

from typing import Any

from servolens.simulation.digital import HELD

__all__ = ["NEVER", "kalman"]

NEVER = 1e99
"""Error of a reading, in standard deviations of the sensor, from which on it counts as not taken."""


def kalman(n: int, model: Any, late: Any, kick: Any, rests: Any, gains: Any, variance: Any) -> int:
    """Fill `gains`, three a sample, and the `variance` of each innovation in units of the sensor's; return `n`.

    Parameters
    ----------
    n : int
        Samples.
    model : array
        Velocity and position that a velocity of 1 has left and has given a sample later, share and position and
        velocity that an acceleration of 1 has, its variance in the long run.
    late, kick : array, shape (n,)
        Position that a late instant adds to the reading, and velocity that it takes from the axis, in standard
        deviations of the sensor. A reading whose error is above `NEVER` was not taken.
    rests : array, shape (n,)
        Not 0 where the axis rests until the next sample, held by something: then nothing shakes it.
    gains, variance : array, shape (3n,) and (n,)
        To fill.
    """
    left, given, kept, far, fast, power = model[0], model[1], model[2], model[3], model[4], model[5]
    fresh = power * (1.0 - kept * kept)
    yy, yv, ya, vv, va, aa = 0.0, 0.0, 0.0, 0.0, 0.0, power
    for k in range(n):
        read = 0.0 if late[k] > NEVER else 1.0
        error = read * late[k]
        s = yy + 1.0 + error * error
        gy, gv, ga = read * yy / s, read * (yv - kick[k] * error) / s, read * ya / s
        gains[3 * k], gains[3 * k + 1], gains[3 * k + 2], variance[k] = gy, gv, ga, s
        yy, yv, ya = yy - gy * gy * s, yv - gy * gv * s, ya - gy * ga * s
        vv, va, aa = vv + kick[k] * kick[k] - gv * gv * s, va - gv * ga * s, aa - ga * ga * s
        if rests[k] != 0.0:
            gains[3 * k + 1] = HELD
            yv, ya, vv, va, aa = 0.0, 0.0, 0.0, 0.0, power
            continue
        # F P Fᵀ with F = [1 given far; 0 left fast; 0 0 kept], row by row
        ay, av, aw = yy + given * yv + far * ya, yv + given * vv + far * va, ya + given * va + far * aa
        bv, bw = left * vv + fast * va, left * va + fast * aa
        yy, yv, ya = ay + given * av + far * aw, left * av + fast * aw, kept * aw
        vv, va, aa = left * bv + fast * bw, kept * bw, kept * kept * aa + fresh
    return n
