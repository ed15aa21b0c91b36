"""Make the pictures of the README and of the paper's page from what the demo finds (``make pictures``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from servolens.demo.experiment import run_experiment
from servolens.demo.story import law_panels
from servolens.report.figures_design import columns, draw_settling
from servolens.report.plots import plot_damping_laws
from servolens.report.style import new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from servolens.demo.experiment import Demo

WIDTH = 7.6
"""Of a picture [inches]."""


@styled
def damping_laws(demo: Demo) -> Figure:
    """Draw damping against speed, by both routes."""
    figure = new_figure(3.3, WIDTH)
    panels = law_panels(demo)
    for ax, (title, laws, points) in zip(figure.subplots(1, len(panels), sharey=True), panels, strict=True):
        plot_damping_laws(laws, points, title=title, ax=ax)
    return figure


@styled
def settling_times(demo: Demo) -> Figure:
    """Draw settling time against the gain, on the linear and on the nonlinear model."""
    figure = new_figure(4.0, WIDTH)
    draw_settling(columns(demo.sampled[-1]), figure.add_subplot(), legend=True)
    return figure


@styled
def main() -> None:
    """Write ``docs/images/*.svg``."""
    folder = Path(__file__).with_name("images")
    folder.mkdir(exist_ok=True)
    demo = run_experiment()
    for name, figure in (("damping-laws", damping_laws(demo)), ("settling-times", settling_times(demo))):
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        print(f"docs/images/{name}.svg")


if __name__ == "__main__":
    main()
