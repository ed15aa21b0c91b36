"""From one measured step to a PD gain: the whole way in one noun a line."""

from __future__ import annotations

from servolens import PDSpec, compare, identify
from servolens.lab import NLM3, step_record


def main() -> None:
    record = step_record(NLM3, kp=100, encoder=1e-5, noise=1e-5, seed=1)
    fit = identify(record)
    design = compare(fit.constant.plant, fit.velocity.plant, PDSpec(kp=100, settling_time=0.5))
    crossed = design.linear_on_nonlinear

    for name, quantity in fit.velocity.quantities.items():
        print(f"{name} = {quantity.value:.5g} ± {quantity.stderr:.2g} {quantity.unit}")
    own = design.nonlinear.verified[0]
    print(
        f"linear model:    kd = {design.linear.kd:.3f}, settles in {crossed.settling_time:.3f} s on the nonlinear plant"
    )
    print(f"nonlinear model: kd = {design.nonlinear.kd:.3f}, settles in {own.settling_time:.3f} s")


if __name__ == "__main__":
    main()
