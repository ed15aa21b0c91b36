"""The bridge to python-control: plants and loops as its nonlinear systems.

What comes out is an ordinary ``NonlinearIOSystem``; everything in it derives from the plant's one equation of motion.
What python-control does with such systems, and what to do about it (version 0.10.2, each shown in the tests):

* ``input_output_response`` interpolates inputs linearly: a voltage that a controller holds becomes a ramp from sample
  to sample, which puts the paper's cart 1 mm off on a 0.1 m step at 1 kHz. :func:`held_response` holds it.
* Its default solver, RK45 with ``rtol`` 1e-3, is 0.2 mm off on that step, and any solver may step over a pulse of 50 ms
  that follows a rest. Pass ``solve_ivp_kwargs=SOLVER``, or use :func:`held_response`, which starts anew wherever an
  input changes.
* Whether a response can be trusted, :func:`check_response` tells, or ``held_response(..., check=True)``: it simulates
  the same with the kernel and warns (:class:`ResponseWarning`) if the two are apart.
* A sign in the equations makes the stiff solvers return nonsense as success, or never return. Dry friction is therefore
  smoothed here, ``level·tanh(velocity / friction_width)``: a push below the level makes the axis creep, at up to a few
  times that speed, instead of holding it. With 1e-3 m/s that is 0.3 to 0.8 mm on a sticky cart's step of 1.5 s, twice
  that with a Stribeck curve, and in proportion for other widths. Much smaller widths bring the nonsense back: at 1e-12
  m/s BDF and Radau are metres off, LSODA does not return. An axis that sticks is simulated by
  :func:`servolens.simulation.loop.simulate_loop`. Presliding friction needs no smoothing.
* What effects remember becomes states: a load behind a transmission, lags of actuator and sensor, the integral of a
  drive's speed loop, presliding friction. Zeros are an axis at rest at 0 under no command; for another beginning take
  :meth:`PlantSystem.at_rest`. Behind a transmission the states ``position`` and ``velocity`` are the motor's, the
  outputs of those names the load's.
* No finite number of states holds a delay. A plant with one is refused, or approximated with ``delay_order``.
* ``interconnect`` merges the parameters of all parts by name: of two plants with a ``gain`` each, both get the last
  one's. Give each its own `prefix`.
* A name in ``params=`` that no system has is ignored.
* ``frequency_response``, ``bode_plot`` and their like take linear systems: linearise first. A plant or loop from here
  is linearised exactly, an interconnection by python-control's differences.
* The digital controller itself, PID and cascade included, is :func:`digital_controller`, in discrete time.
  python-control does not mix discrete and continuous systems: sample the linearised axis first.
* An interconnection cannot be pickled; the systems made here can.
"""

from servolens.bridge.checking import ResponseWarning, check_response
from servolens.bridge.digital import ControllerSystem, digital_controller
from servolens.bridge.response import SOLVER, held_response
from servolens.bridge.system import PlantSystem, closed_loop, to_control

__all__ = [
    "SOLVER",
    "ControllerSystem",
    "PlantSystem",
    "ResponseWarning",
    "check_response",
    "closed_loop",
    "digital_controller",
    "held_response",
    "to_control",
]
