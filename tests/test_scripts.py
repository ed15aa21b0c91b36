"""Ten lines each, as users of other libraries would write them from the README alone."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from servolens import lab

SCRIPTS = {
    "lmfit: fit, report, a parameter and its error": """
        import servolens as sl
        record = sl.read_record("step.csv", settings={"kp": 60, "kd": 0})
        result = sl.fit("coulomb_friction", record)
        print(result.summary())
        level = result.quantities["coulomb_friction.level"]
        print(f"level = {level:.3f} +/- {level.stderr:.3f}")
        assert abs(float(level) - 0.3) < 5 * level.stderr
        assert abs(result.residuals()[0]).max() < 1e-4
        """,
    "lmfit: vary=False, min and max, a prior, confidence intervals": """
        import servolens as sl
        from servolens import CoulombFriction, Plant
        start = Plant(gain=2, damping=5, effects=(CoulombFriction(level=0.1),))
        result = sl.fit(start, "step.csv", kp=60, fixed={"damping": 6.0}, bounds={"gain": (1.5, 2.5)},
                        priors={"coulomb_friction.level": (0.3, 0.1)})
        assert result.plant.damping == 6.0
        low, high = sl.profile(result, "gain").interval
        assert low < result.plant.gain < high
        result.save("fit.json")
        assert sl.Fit.from_json("fit.json").plant == result.plant
        """,
    "python-control: a Bode plot and a step of the loop": """
        import control as ct
        import numpy as np
        import servolens as sl
        found = sl.identify("step.csv", kp=60, kd=0)
        axis = sl.to_control(found)
        ct.bode_plot(axis.linearize([0, 0.1], [0]))
        time = np.arange(0, 1, 1e-3)
        response = sl.held_response(sl.closed_loop(found, kp=60, kd=2), time, np.full_like(time, 0.1))
        assert abs(response.outputs[0][-1] - 0.1) < 2e-3
        """,
    "python-control: a time response is a record": """
        import control as ct
        import numpy as np
        import servolens as sl
        time = np.arange(0, 1, 1e-3)
        axis = ct.tf([1.9], [1, 6, 0], inputs="voltage", outputs="position")
        volts = np.where(time < 0.3, 4.0, -3.0)
        response = ct.forced_response(axis, time, volts)
        found = sl.identify(response, model="constant")
        print(found.model.quantities["gain"])
        assert abs(found.plant.damping - 6) < 0.1
        """,
    "pandas: a frame in, tables out": """
        import pandas as pd
        import servolens as sl
        log = pd.read_csv("step.csv")
        found = sl.identify(log, kp=60, kd=0)
        table = found.to_dataframe()
        print(table.round(3))
        assert 1.8 < table.loc[("velocity", "gain"), "value"] < 2.0
        frame = found.simulate(log, kp=60, kd=0).trajectories()
        assert (frame["the model"] - frame["measured"]).abs().mean() < 1e-3
        """,
    "pandas: many runs, the worst of them": """
        import pandas as pd
        import servolens as sl
        logs = [pd.read_csv(f"step{i}.csv") for i in (1, 2)]
        model = sl.fit(["coulomb_friction"], logs, kp=60, kd=0)
        errors = sl.predict({"fitted": model, "without friction": model.plant.without_effect("coulomb_friction")},
                            logs, kp=60, kd=0).to_dataframe()
        worst = errors["percent_error"].groupby("model").max()
        print(worst)
        assert worst["fitted"] < 0.1 * worst["without friction"]
        """,
    "notebook: look at everything": """
        import matplotlib.pyplot as plt
        import servolens as sl
        found = sl.diagnose(["step1.csv", "step2.csv"], kp=60, kd=0, effort="quick")
        assert "<table" in found._repr_html_() and "Coulomb friction" in repr(found)
        figure, axes = plt.subplots(1, 2)
        found.plot(ax=axes[0])
        design = sl.tune(found, sl.PDSpec(kp=60, settling_time=0.8))
        design.plot(ax=axes[1]).set_title("my gain")
        figure.savefig("both.png")
        """,
    "notebook: from a log to a gain in one line": """
        import servolens as sl
        design = sl.tune("step.csv", sl.PDSpec(kp=60, settling_time=0.8), effort="quick", kp=60, kd=0)
        print(design)
        for name, light in design.lights.items():
            print(name, light.light, light.sentence)
        print([cause.effect for cause in design.diagnosis.causes], [one.usable for one in design.check])
        assert design.kd < design.recommended.kd
        print(design.to_dataframe())
        try:
            sl.tune("step.csv", 0.8)
        except sl.InputError as error:
            print(error)
        """,
}


@pytest.fixture
def folder(tmp_path):
    cart = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    for name, seed in (("step", 1), ("step1", 2), ("step2", 3)):
        record = lab.step_record(cart, kp=60, noise=1e-5, seed=seed)
        columns = np.column_stack([record.time, record.reference, record.position, record.voltage])
        head = "time [s],reference [m],position [m],voltage [V]"
        np.savetxt(tmp_path / f"{name}.csv", columns, delimiter=",", header=head, comments="")
    return tmp_path


@pytest.mark.parametrize("name", SCRIPTS)
def test_script_of_ten_lines_runs(name, folder):
    lines = [line[8:] for line in SCRIPTS[name].strip("\n").splitlines()]
    assert len(lines) <= 14
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "Agg", "PYTHONWARNINGS": "error::UserWarning"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
