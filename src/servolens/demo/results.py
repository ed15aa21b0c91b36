"""The demo's machine-readable result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servolens.demo.experiment import DELTA, PAPER_ANSWERS, PRINTED, SHORT_PIECE, TRUTH

if TYPE_CHECKING:
    from servolens.demo.experiment import Demo
    from servolens.identification.varying import VaryingDamping

__all__ = ["results_json"]


def results_json(demo: Demo) -> dict[str, Any]:
    """Return the fields of ``servolens.demo/1`` without the file's header."""
    return {
        "cart": _truth(),
        "records": [record.name for record in demo.records],
        "identifications": {fit.records[0].name: fit.to_json() for fit in demo.fits},
        "delta": {
            "value": DELTA,
            "varying": {
                record.name: _varying(varying) for record, varying in zip(demo.training, demo.limited, strict=True)
            },
            "short_pieces": {
                "piece": SHORT_PIECE,
                "record": demo.training[0].name,
                "unconstrained": _varying(demo.short),
                "constrained": _varying(demo.short_limited),
            },
        },
        "table_one": _table_one(demo),
        "design": {
            "sampled": {
                fit.records[0].name: comparison.to_json()
                for fit, comparison in zip(demo.fits, demo.sampled, strict=True)
            },
            "continuous": {demo.fits[-1].records[0].name: demo.continuous.to_json()},
        },
        "routes": {
            "from_pieces": [design.kd for design in demo.by_pieces],
            "from_integral_equation": [comparison.nonlinear.kd for comparison in demo.sampled],
            "true": demo.on_truth.kd,
            "records": [record.name for record in demo.training],
        },
        "on_cart": [{"gain": run.label, "kd": run.kd, "settling_time": run.settling_time} for run in demo.on_cart],
        "paper": {
            name: {**demo.printed[name].to_json(), "paper_kd": PAPER_ANSWERS.get(name), "reason": _no_answer(name)}
            for name in PRINTED
        },
        "hidden": demo.hidden.to_json(),
    }


def _truth() -> dict[str, Any]:
    return {
        "gain": TRUTH.gain,
        "damping": TRUTH.damping,
        "effects": {name: dict(values) for name, values in TRUTH.effects.items()},
    }


def _varying(varying: VaryingDamping) -> dict[str, Any]:
    return {
        "gain": varying.gain,
        "edges": varying.edges.tolist(),
        "damping": varying.damping.tolist(),
        "active": list(varying.active),
    }


def _table_one(demo: Demo) -> dict[str, Any]:
    prediction = demo.prediction
    gains = [(c.kp, c.kd) for record in demo.records if (c := record.controller) is not None]
    return {
        "models": list(prediction.models),
        "gains": [{"kp": kp, "kd": kd} for kp, kd in gains],
        "percent_error": [[error.percent_error for error in row] for row in prediction.errors],
        "mean_abs_error": [[error.mean_abs_error for error in row] for row in prediction.errors],
        "held_out": demo.held_out.tolist(),
        "average_percent_error": list(prediction.average_percent),
    }


def _no_answer(name: str) -> str | None:
    return None if name in PAPER_ANSWERS else "the paper gives no gain for this model"
