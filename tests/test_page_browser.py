"""The page as a browser shows it: on a phone, a tablet and a desk, dark, printed, by keyboard, and without a script."""

from __future__ import annotations

import csv
import io
import re

import numpy as np
import pytest
from test_report import HOSTILE

from servolens import lab
from servolens.design import PDSpec, evaluate
from servolens.design.settle import step_response
from servolens.report import write_diagnosis_report, write_study
from servolens.report.printing import chromium
from servolens.study import study_records

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not here: install the extra dev")
pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is here to show pages")
WIDTHS = {"phone": 390, "tablet": 800, "desk": 1400}
FORMULA, WIDE_FORMULA = "=1+1", "＝1+1"
OF_THE_STEP = 1e-3


@pytest.fixture(scope="module")
def study():
    runs = [
        run.with_({"name": name})
        for run, name in zip(lab.table_one(lab.NLM3, 5)[4:7], (HOSTILE, FORMULA, WIDE_FORMULA), strict=True)
    ]
    return study_records(runs[:2], PDSpec(kp=100, settling_time=0.5), heldout=runs[2:], effort="quick")


@pytest.fixture(scope="module")
def path(study, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "report.html"
    write_study(file, study)
    return file


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as tools:
        shown = tools.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        yield shown
        shown.close()


class Shown:
    """A page that is open, and what it did beside being shown."""

    def __init__(self, browser, path, width=1400, **settings):
        self.context = browser.new_context(viewport={"width": width, "height": 900}, **settings)
        self.page = self.context.new_page()
        self.told, self.asked = [], []
        self.page.on("console", lambda message: self.told.append(message.text))
        self.page.on("pageerror", lambda error: self.told.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())

    def figure(self, name):
        found = self.page.locator(f'figure[data-name="{name}"]')
        found.scroll_into_view_if_needed()
        return found


@pytest.fixture
def shown(browser, path):
    opened = []

    def show(**settings):
        opened.append(Shown(browser, path, **settings))
        return opened[-1]

    yield show
    for one in opened:
        one.context.close()


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_page_fits_says_nothing_and_asks_for_nothing(shown, path, width):
    one = shown(width=width)
    one.page.wait_for_function("servolensPlaygrounds[0].isWarm")
    wide = one.page.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert wide[0] <= wide[1]
    cut = one.page.evaluate(
        """[...document.querySelectorAll('.table, .legend, figcaption, .lights li, h1, h2, p')]
        .filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.className + e.textContent.slice(0, 60))"""
    )
    assert cut == []
    assert one.told == []
    assert one.asked == [path.as_uri()]


def test_buttons_of_a_figure_stand_in_one_row(shown):
    one = shown(width=390)
    rows = one.page.evaluate(
        """[...document.querySelectorAll('.tools')].filter((e) => e.getClientRects().length)
        .map((e) => new Set([...e.querySelectorAll('button')].filter((b) => b.getClientRects().length)
        .map((b) => Math.round(b.getBoundingClientRect().top))).size)"""
    )
    assert set(rows) == {1}


def test_letters_of_figures_can_be_read_on_a_phone(shown):
    one = shown(width=390)
    sizes = one.page.evaluate(
        """[...document.querySelectorAll('figure .picture > svg')].filter((svg) => svg.getClientRects().length)
        .map((svg) => 8.5 * svg.getBoundingClientRect().width / svg.viewBox.baseVal.width)"""
    )
    assert min(sizes) > 8.0


def test_every_figure_is_told_in_words_and_every_heading_has_its_place(shown):
    one = shown()
    told = one.page.evaluate("[...document.querySelectorAll('.drawing')].map((e) => e.getAttribute('aria-label'))")
    assert len(told) > 8
    assert all(len(text) > 40 for text in told)
    assert len(set(told)) == len(told)
    hidden = "[...document.querySelectorAll('.picture > svg')].every((e) => e.getAttribute('aria-hidden') === 'true')"
    assert one.page.evaluate(hidden)


def test_what_matters_comes_first(shown):
    one = shown()
    lights = one.page.locator(".lights li").all_inner_texts()
    assert [text.split(":")[0] for text in lights] == ["Data", "Model", "Gain"]
    names = one.page.evaluate("[...document.querySelectorAll('figure[data-name]')].map((e) => e.dataset.name)")
    wanted = ["prediction", "wrong-shares", "wrong-instrument", "wrong-residuals", "gain", "data"]
    assert names[0] == "prediction"
    assert [name for name in names if name in wanted] == wanted
    first = one.figure("prediction").locator("figcaption").inner_text()
    assert "data that the models were not fitted to" in first
    top = one.page.evaluate("document.querySelector('.lights').getBoundingClientRect().top")
    assert top < one.page.evaluate("document.querySelector('figure').getBoundingClientRect().top")


def luminance(colour):
    parts = [int(part) / 255 for part in re.findall(r"\d+", colour)[:3]]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_and_lines_stand_out_in_both_schemes(shown, scheme):
    one = shown(color_scheme=scheme)
    style = "(e) => [getComputedStyle(e).color, getComputedStyle(e).stroke, getComputedStyle(e).fill]"
    paper = luminance(one.page.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert (paper < 0.1) == (scheme == "dark")
    text = luminance(one.page.locator("p").nth(2).evaluate(style)[0])
    line = luminance(one.page.locator(".live-step-velocity path").first.evaluate(style)[1])
    letters = one.page.locator('[data-name="gain"] .axis-x g[style*="fill"]').last
    letter = luminance(letters.evaluate(style)[2])
    for seen, least in ((text, 7.0), (line, 3.0), (letter, 7.0)):
        brighter, darker = max(seen, paper) + 0.05, min(seen, paper) + 0.05
        assert brighter / darker > least


def test_print_is_light_and_without_controls(shown):
    one = shown(color_scheme="dark")
    one.page.emulate_media(media="print", color_scheme="dark")
    assert luminance(one.page.evaluate("getComputedStyle(document.body).backgroundColor")) > 0.9
    assert not one.page.locator(".tools").first.is_visible()
    assert not one.page.locator(".sliders").first.is_visible()
    assert one.page.locator("details .table").first.evaluate("(e) => e.getBoundingClientRect().height") > 20
    sizes = (
        "['.lead', 'main p', 'figcaption'].map((s) => parseFloat(getComputedStyle(document.querySelector(s)).fontSize))"
    )
    assert sorted(one.page.evaluate(sizes), reverse=True) == one.page.evaluate(sizes)
    one.page.set_viewport_size({"width": 680, "height": 900})  # A4 less its margins
    cut = "[...document.querySelectorAll('.table')].filter((e) => e.scrollWidth > e.clientWidth + 1).length"
    assert one.page.evaluate(cut) == 0


def test_without_a_script_the_page_is_whole(shown):
    one = shown(java_script_enabled=False)
    assert one.page.locator("figure .picture > svg").count() > 12
    assert one.page.locator("button, input").count() == 0
    step = one.page.locator(".live-step-velocity path").first
    assert len(step.get_attribute("d")) > 300
    assert one.page.locator(".live-settling-spread").count() == 1
    assert "<script>alert" not in one.page.locator("main").inner_html()


def test_keys_move_the_cursor_zoom_and_undo_it(shown):
    one = shown()
    figure = one.figure("prediction")
    drawing, readout = figure.locator(".drawing"), figure.locator(".readout")
    drawing.focus()
    one.page.keyboard.press("ArrowRight")
    first = readout.inner_text()
    assert "measured: " in first
    assert "with the causes: " in first
    for _ in range(5):
        one.page.keyboard.press("Shift+ArrowRight")
    assert readout.inner_text() != first
    curve = figure.locator(".panel-0 .moved")
    one.page.keyboard.press("+")
    scale = float(re.match(r"matrix\(([\d.]+) ", curve.first.get_attribute("transform"))[1])
    assert scale == pytest.approx(2.0)
    assert figure.get_by_text("Whole picture").is_visible()
    one.page.keyboard.press("0")
    assert curve.first.get_attribute("transform") == "matrix(1 0 0 1 0 0)"
    assert not figure.get_by_text("Whole picture").is_visible()
    assert one.told == []


def test_rectangle_zooms_into_what_it_holds(shown):
    one = shown()
    figure = one.figure("settling")
    box = figure.locator(".picture svg").bounding_box()
    corners = [(box["x"] + box["width"] * a, box["y"] + box["height"] * b) for a, b in ((0.4, 0.3), (0.7, 0.7))]
    one.page.mouse.move(*corners[0])
    one.page.mouse.down()
    one.page.mouse.move(*corners[1], steps=4)
    one.page.mouse.up()
    low, high = one.page.evaluate("servolensFigures.get('settling').panels[0].seen.x")
    first, last = one.page.evaluate("servolensFigures.get('settling').panels[0].whole.x")
    assert first < low < high < last
    ticks = [float(text) for text in figure.locator(".ticks text[text-anchor=middle]").all_text_contents()]
    assert len(ticks) >= 3
    assert low - 1e-9 <= min(ticks)
    assert max(ticks) <= high + 1e-9


def numbers_of(one, figure):
    with one.page.expect_download() as waiting:
        figure.get_by_role("button", name="CSV").click()
    text = waiting.value.path().read_text(encoding="utf-8-sig")
    return waiting.value.suggested_filename, list(csv.DictReader(io.StringIO(text)))


def test_numbers_of_a_figure_are_those_that_were_measured(shown, study):
    one = shown()
    name, rows = numbers_of(one, one.figure("prediction"))
    assert name == "prediction.csv"
    record = study.diagnosis.heldout[0]
    measured = [(float(row["x"]), float(row["y"])) for row in rows if row["curve"] == "measured"]
    time, position = np.array(measured).T
    assert time.size > 300
    assert np.abs(position - np.interp(time, record.time, record.position)).max() <= OF_THE_STEP * record.step_size
    assert {row["y is"] for row in rows} >= {"Position [m]"}


def test_numbers_hold_no_formula(shown):
    one = shown()
    panels = {row["panel"] for key in ("data", "prediction") for row in numbers_of(one, one.figure(key))[1]}
    assert {"'=1+1", "'＝1+1 (held out)"} <= panels
    assert not any(re.match(r" *[=+\-@＝\t\r]", panel) for panel in panels)


def move(slider, value):
    slider.evaluate("(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", str(value))


def test_sliders_show_what_the_kernel_says(shown, study):
    one = shown()
    figure = one.figure("gain")
    one.page.wait_for_function("servolensPlaygrounds[0].isWarm")
    kp, kd = figure.locator("input[type=range]").all()
    move(kp, 120)
    move(kd, 4.5)
    one.page.wait_for_function("!servolensPlaygrounds[0].isRunning && !servolensPlaygrounds[0].isNew")
    gains = one.page.evaluate("servolensPlaygrounds[0].gains")
    spec = PDSpec(kp=gains["kp"], settling_time=0.5)
    assert gains == {"kp": 120, "free": 4.5, "integral": 0}
    found = evaluate(study.model.plant, spec, 4.5)
    run = step_response(study.model.plant, spec, 4.5, 1.2)
    line = one.page.evaluate("(({x, y}) => [x, y])(servolensPlaygrounds[0].left.lines[0])")
    assert np.abs(np.array(line[1]) - np.interp(line[0], run.time, run.position)).max() <= OF_THE_STEP * 0.1
    told = figure.locator(".told").inner_text()
    assert f"settles in {found.settling_time:.3g} s" in told
    assert ("it meets the target" in told) == found.meets
    assert "of 16 axes as they may be meet what is asked for" in told
    drawn = figure.locator(".live-step-velocity path").get_attribute("d")
    box, scale = one.page.evaluate("((p) => [p.box, p.whole])(servolensPlaygrounds[0].left)")
    points = np.array([[float(n) for n in pair.split()] for pair in re.findall(r"[ML]([-\d. ]+)", drawn)])
    height = (1 - (points[:, 1] - box[1]) / box[3]) * (scale["y"][1] - scale["y"][0]) + scale["y"][0]
    time = (points[:, 0] - box[0]) / box[2] * (scale["x"][1] - scale["x"][0])
    assert np.abs(height - np.interp(time, run.time, run.position)).max() <= OF_THE_STEP * 0.1 + 0.005 / box[3] * 0.2


def test_settling_curve_follows_the_slider_of_kp(shown, study):
    one = shown()
    figure = one.figure("gain")
    one.page.wait_for_function("servolensPlaygrounds[0].isWarm")
    move(figure.locator("input[type=range]").first, 70)
    one.page.wait_for_function("!servolensPlaygrounds[0].isRunning && !servolensPlaygrounds[0].isNew", timeout=60_000)
    x, y = one.page.evaluate("(({x, y}) => [x, y])(servolensPlaygrounds[0].right.lines[0])")
    spec = PDSpec(kp=70, settling_time=0.5)
    told = [(kd, time) for kd, time in zip(x, y, strict=True) if kd is not None and time is not None][::20]
    assert len(told) >= 6
    for kd, time in told:
        assert evaluate(study.model.plant, spec, kd, duration=2.0).settling_time == pytest.approx(time, abs=2e-3)
    assert figure.locator(".live-designed").first.is_hidden()
    figure.get_by_role("button", name="As at first").click()
    assert one.page.evaluate("servolensPlaygrounds[0].gains.kp") == 100
    one.page.wait_for_function("!servolensPlaygrounds[0].isRunning && !servolensPlaygrounds[0].isNew", timeout=60_000)
    assert figure.locator(".live-designed").first.evaluate("(e) => e.style.display") == ""


def test_slider_is_moved_by_keys_within_a_frame(shown):
    one = shown()
    figure = one.figure("gain")
    one.page.wait_for_function("servolensPlaygrounds[0].isWarm")
    kd = figure.locator("input[type=range]").nth(1)
    kd.focus()
    before = figure.locator(".live-step-velocity path").get_attribute("d")
    one.page.evaluate("servolensPlaygrounds[0].frames = []")
    for _ in range(40):
        one.page.keyboard.press("ArrowLeft")
    one.page.wait_for_function("!servolensPlaygrounds[0].isRunning && !servolensPlaygrounds[0].isNew")
    assert figure.locator(".live-step-velocity path").get_attribute("d") != before
    frames = one.page.evaluate("servolensPlaygrounds[0].frames")
    assert len(frames) > 10
    assert np.median(frames) <= 16.0
    assert one.told == []


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_page_of_a_diagnosis_fits_and_has_sliders_that_move_its_model(browser, study, tmp_path, width):
    file = tmp_path / "diagnosis.html"
    write_diagnosis_report(file, study.diagnosis)
    one = Shown(browser, file, width=width)
    figure = one.figure("gain")
    one.page.wait_for_function("servolensPlaygrounds[0].isWarm")
    assert one.page.evaluate("document.documentElement.scrollWidth") <= width
    kp, kd = figure.locator("input[type=range]").all()
    move(kp, 120)
    move(kd, 4.5)
    one.page.wait_for_function("!servolensPlaygrounds[0].isRunning && !servolensPlaygrounds[0].isNew", timeout=60_000)
    line = one.page.evaluate("(({x, y}) => [x, y])(servolensPlaygrounds[0].left.lines[0])")
    spec = PDSpec(kp=120, settling_time=0.5, reference=study.design.spec.reference)
    run = step_response(study.diagnosis.plant, spec, 4.5, max(line[0]) + 0.1)
    assert np.abs(np.array(line[1]) - np.interp(line[0], run.time, run.position)).max() <= OF_THE_STEP * 0.1
    assert (one.told, one.asked) == ([], [file.as_uri()])
    one.context.close()
