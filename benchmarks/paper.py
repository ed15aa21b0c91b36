"""Compute every number of the paper again, and write the tables of docs/paper.md (``make paper``, half a minute).

The paper's measured responses are not published. What it measured is measured here on virtual carts that obey its own
nonlinear models: NLm1 at Kp 60, NLm2 at Kp 80 and NLm3 at Kp 100, logged at 1 kHz with an encoder and noise of 10 µm.
What follows from its printed parameters alone is computed from these.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import solve_ivp

from servolens import lab
from servolens.demo.experiment import PAPER_ANSWERS, PRINTED, SEED, SPEC, plant_of
from servolens.design import PDSpec, evaluate, tune
from servolens.identification import identify
from servolens.prediction import predict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification import Identification
    from servolens.record import Record

PAGE = Path(__file__).parents[1] / "docs" / "paper.md"
LATEST = Path(__file__).with_name("latest.json")
GAINS = (60, 80, 100)
DURATION, PIECE, DELTA = 0.9, 0.15, 0.5
"""Of a step and of a piece [s], δ of eq. 18 [1/s]: six pieces, as in the paper."""
VOLTAGES = ((-2.3, 5.9), (-4.0, 8.0), (-6.1, 9.9))
CONSTANT = ((6.1520, 1.8545), (5.4916, 1.7482), (4.5866, 1.7866))
"""C and β of eqs. 17, 26, 27."""
LAWS = (
    (17.3264, 13.1068, 5.9986, 1.9165),
    (22.1357, 18.2233, 5.6035, 1.9180),
    (15.2528, 5.9934, 3.7990, 1.9100),
)
"""α₁, α₂, γ, β of eqs. 24, 28, 29."""
OWN_ERRORS = {"Lm2": 7.1, "NLm2": 1.0, "Lm3": 7.4, "NLm3": 1.7}
"""Mean absolute errors of figure 9 in mm."""
TABLE_ONE = (
    (7.0, 18.96, 18.73, 1.0, 3.84, 5.63),
    (8.24, 9.20, 10.10, 3.0, 4.80, 5.87),
    (11.08, 7.1, 12.04, 4.70, 1.10, 6.12),
    (5.95, 4.65, 3.95, 3.76, 3.39, 3.53),
    (14.3, 15.05, 15.97, 3.21, 3.01, 3.78),
    (14.71, 17.5, 7.4, 6.50, 6.93, 1.70),
    (3.25, 3.97, 4.72, 2.81, 3.10, 3.55),
    (9.70, 8.93, 11.50, 4.60, 5.20, 4.00),
)
AVERAGES = (9.3, 10.6, 10.6, 3.7, 3.9, 4.3)
SPEC_36 = PDSpec(**SPEC, control="continuous")


def main() -> None:
    """Write the tables between the marks of the page."""
    carts = (lab.NLM1, lab.NLM2, lab.NLM3)
    steps = [
        lab.step_record(cart, kp, noise=1e-5, seed=SEED + kp, duration=DURATION)
        for cart, kp in zip(carts, GAINS, strict=True)
    ]
    found = [identify(step, piece=PIECE) for step in steps]
    page = PAGE.read_text(encoding="utf-8")
    for name, table in (
        ("voltages", voltages(steps)),
        ("constant", constant(found)),
        ("varying", varying(steps[0])),
        ("laws", laws(found)),
        ("errors", own_errors(found)),
        ("table one", table_one()),
        ("design", design()),
        ("answers", answers()),
        ("readings", readings()),
        ("speed", speed()),
    ):
        page = _between(page, name, table)
    PAGE.write_text(page, encoding="utf-8")
    print(f"Wrote {PAGE}")


def voltages(steps: Sequence[Record]) -> str:
    """Return the ranges of the voltage (section III.B) and its mean at Kp 60 (III.A.2)."""
    rows = []
    for kp, step, (low, high) in zip(GAINS, steps, VOLTAGES, strict=True):
        assert step.voltage is not None  # the laboratory logs it
        rows.append(
            [f"voltage, Kp {kp}", f"{low} to {high} V", f"{step.voltage.min():.1f} to {step.voltage.max():.1f} V"]
        )
    mean = np.mean(steps[0].voltage)  # type: ignore[arg-type] # the laboratory logs it
    return _table(("", "paper", "virtual cart"), [*rows, ["its mean, Kp 60", "0.3 V", f"{mean:.1f} V"]])


def constant(found: Sequence[Identification]) -> str:
    """Return the constant models."""
    rows = []
    for kp, fit, (c, beta) in zip(GAINS, found, CONSTANT, strict=True):
        assert fit.constant is not None  # asked for
        plant = fit.constant.plant
        rows.append([f"C, Kp {kp} [1/s]", f"{c:.4f}", f"{plant.damping:.4f}", _off(plant.damping, c)])
        rows.append([f"β, Kp {kp} [m/s²/V]", f"{beta:.4f}", f"{plant.gain:.4f}", _off(plant.gain, beta)])
    return _table(("eqs. 17, 26, 27", "paper, real cart", "ours, virtual cart", "difference"), rows)


def varying(step: Record) -> str:
    """Return gain and error of the time-varying damping, without and with eq. 18 (figures 4 to 6)."""
    free, limited = (identify(step, model="varying", piece=PIECE, delta=delta) for delta in (None, DELTA))
    assert free.varying is not None
    assert limited.varying is not None
    change = 100 * abs(free.varying.gain / limited.varying.gain - 1)
    rows = [
        ["β without eq. 18", "1.9352", f"{free.varying.gain:.4f}"],
        ["β with δ = 0.5", "1.9165", f"{limited.varying.gain:.4f}"],
        ["change", "0.9 %", f"{change:.1f} %"],
        ["mean absolute error, without", "3.09 mm", _millimetres(free)],
        ["mean absolute error, with", "2.57 mm", _millimetres(limited)],
        ["c₁ … c₆ without [1/s]", "figure 4", " ".join(f"{c:.1f}" for c in free.varying.damping)],
        ["c₁ … c₆ with [1/s]", "figure 5", " ".join(f"{c:.1f}" for c in limited.varying.damping)],
    ]
    return _table(("Kp 60", "paper, real cart", "ours, virtual cart"), rows)


def laws(found: Sequence[Identification]) -> str:
    """Return the laws of damping against speed, by both routes."""
    rows = []
    for kp, fit, law in zip(GAINS, found, LAWS, strict=True):
        assert fit.velocity is not None
        gain, damping, alpha1, alpha2 = fit.velocity.plant.values
        pieces = fit.law_from_pieces
        by_pieces = (
            ["none"] * 4 if pieces is None else [f"{x:.4g}" for x in (*pieces.values[2:], *pieces.values[1::-1])]
        )
        ours = (alpha1, alpha2, damping, gain)
        for name, own, piece, value in zip(
            ("α₁ [1/s]", "α₂ [s/m]", "γ [1/s]", "β [m/s²/V]"), law, by_pieces, ours, strict=True
        ):
            rows.append([f"{name}, Kp {kp}", f"{own:.4f}", f"{value:.4f}", _off(value, own), piece])
    heads = (
        "eqs. 24, 28, 29",
        "paper",
        "ours, integral equation",
        "difference",
        "ours, through the pieces (eqs. 19–22)",
    )
    return _table(heads, rows)


def own_errors(found: Sequence[Identification]) -> str:
    """Return the errors of figure 9, of models on the record that they were identified from."""
    rows = []
    for name, value in OWN_ERRORS.items():
        fit = found[int(name[-1]) - 1]
        error = fit.errors["velocity" if name.startswith("N") else "constant"][0]
        rows.append(
            [f"{name}, Kp {GAINS[int(name[-1]) - 1]}", f"{value:.1f} mm", f"{1e3 * error.mean_abs_error:.3g} mm"]
        )
    return _table(("figure 9: mean absolute error", "paper, real cart", "ours, virtual cart"), rows)


def table_one() -> str:
    """Return Table I: the paper's, and the printed models on the virtual cart NLm1, in per cent of the step."""
    records = lab.table_one(lab.NLM1, SEED)
    models = {name: plant_of(truth) for name, truth in PRINTED.items()}
    errors = np.array([[e.percent_error for e in row] for row in predict(models, records).errors])
    rows = [
        [record.name, *(f"{p:.2f} / {o:.2f}" for p, o in zip(paper, own, strict=True))]
        for record, paper, own in zip(records, TABLE_ONE, errors, strict=True)
    ]
    printed = np.mean(TABLE_ONE, axis=0)
    rows.append(
        [
            "average, as printed / ours",
            *(f"{p:.1f} / {o:.1f}" for p, o in zip(AVERAGES, errors.mean(axis=0), strict=True)),
        ]
    )
    rows.append(["average of the printed rows", *(f"{p:.2f}" for p in printed)])
    return _table(("paper / ours", *models), rows)


def design() -> str:
    """Return the gains that meet eq. 36 on the printed models."""
    rows = []
    for name, truth in PRINTED.items():
        spans = tune(plant_of(truth), SPEC_36).intervals
        answer = PAPER_ANSWERS.get(name)
        rows.append(
            [name, "–" if answer is None else f"{answer:g}", " and ".join(f"{a:.3f} to {b:.3f}" for a, b in spans)]
        )
    return _table(("model", "paper's least Kd", "ours: every Kd that meets eq. 36"), rows)


def answers() -> str:
    """Return what the gains do on the printed models."""
    linear, nonlinear = plant_of(PRINTED["Lm3"]), plant_of(PRINTED["NLm3"])
    rows = []
    for kd, what in (
        (7.35, "paper, linear"),
        (6.28, "ours, linear"),
        (3.55, "paper, nonlinear"),
        (3.79, "ours, nonlinear"),
    ):
        times = (evaluate(plant, SPEC_36, kd).settling_time for plant in (linear, nonlinear))
        rows.append([f"{kd:g} ({what})", *("–" if t is None else f"{t:.3f} s" for t in times)])
    return _table(("Kd", "settles on Lm3", "settles on NLm3"), rows)


def readings() -> str:
    """Return the least Kd of NLm3 when damping depends on |v|, as eq. 20, or on |e|, as eq. 23 prints."""
    rows = []
    for name, of in (("abs(v), eq. 20 and the conclusions", 1), ("abs(e), eq. 23", 0)):
        least = next(
            (kd for kd in np.arange(0.0, 10.0, 0.01) if _settles(float(kd), of) <= SPEC_36.settling_time), None
        )
        rows.append(
            [
                name,
                f"{_settles(0.0, of):.2f} s",
                f"{_settles(3.55, of):.2f} s",
                "–" if least is None else f"{least:.2f}",
            ]
        )
    return _table(("damping depends on", "settles at Kd 0", "at Kd 3.55", "least Kd"), rows)


def speed() -> str:
    """Return the speed that ``make bench`` measured last."""
    figures = {row["name"]: row["value"] for row in json.loads(LATEST.read_text(encoding="utf-8"))}
    ours = figures["varying-damping fit: faster than least_squares + solve_ivp"]
    return _table(
        ("", "paper", "ours"),
        [["faster than non-linear regression", "up to 7 800 times", f"{ours:,.0f} times".replace(",", " ")]],
    )


def _settles(kd: float, of: int) -> float:
    """Return when NLm3 settles at Kp 100, simulated by SciPy; damping depends on the error or on the speed."""
    alpha1, alpha2, gamma, beta = LAWS[2]

    def motion(_time: float, state: NDArray[np.float64]) -> list[float]:
        error, speed = state
        damping = gamma + alpha1 * np.exp(-alpha2 * abs(state[of]))
        return [speed, -(damping + beta * kd) * speed - beta * SPEC_36.kp * error]

    time = np.linspace(0.0, 3.0, 3001)
    error = solve_ivp(motion, (0.0, 3.0), [SPEC_36.reference, 0.0], t_eval=time, rtol=1e-8, atol=1e-10).y[0]
    outside = np.flatnonzero(np.abs(error) > SPEC_36.band * SPEC_36.reference)
    return float(time[min(outside[-1] + 1, time.size - 1)])


def _millimetres(found: Identification) -> str:
    return f"{1e3 * found.errors['varying'][0].mean_abs_error:.2f} mm"


def _off(value: float, paper: float) -> str:
    percent = round(100 * (value / paper - 1), 1)
    return f"{percent:+.1f} %" if percent else "0.0 %"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    written = [[cell.replace("-", "−") for cell in row] for row in rows]
    lines = [heads, ["---"] * len(heads), *written]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _between(page: str, name: str, table: str) -> str:
    begin, end = f"<!-- {name} begin -->", f"<!-- {name} end -->"
    if begin not in page or end not in page:
        raise SystemExit(f"{PAGE} has no lines {begin} and {end} to write the table between")
    before, _, after = page.partition(begin)
    return f"{before}{begin}\n\n{table}\n\n{end}{after.partition(end)[2]}"


if __name__ == "__main__":
    main()
