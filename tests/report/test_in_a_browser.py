"""Pages in a real browser: console, zoom, hover, keyboard, narrow screens, printing."""

import csv
import json
import re

import numpy as np
import pytest

from heli_jax.report.fit_page import Analysis, write_report
from heli_jax.report.origin import origin
from tests.report.browser import CHROMIUM, browser
from tests.report.conftest import SCRIPT

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"),
    pytest.mark.slow,
]


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def report(sound, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    made = origin(f"a: {SCRIPT} {'long' * 60}", ("config.yaml", "fit.json", "signals.csv"))
    write_report(folder, Analysis(*sound), f"bench {SCRIPT}", {}, made)
    return folder / "report.html"


def over_time(window):
    """Return the figures over log time of one flight, after a check of their axes' titles."""
    groups = window.value("[...heliCharts.groups.keys()]")
    [group] = [g for g in groups if g.startswith("time in the log [s], ")]
    label = "heliCharts.groups.get({}).some(u => u.axes[0].label === 'time in the log [s]')"
    assert window.value(label.format(json.dumps(group)))
    return group


def scales(window, group, k=0):
    return window.value(
        f"(({{min, max}}) => [min, max])(heliCharts.groups.get({json.dumps(group)})[{k}].scales.x)"
    )


def drag(window, plot, start, end):
    """Drag from one fraction of a plot's width to another."""
    window.value(f"{plot}.root.scrollIntoView({{block: 'center'}})")
    x, y, w, h = window.value(
        f"(r => [r.x, r.y, r.width, r.height])({plot}.over.getBoundingClientRect())"
    )
    window.mouse("Moved", x + start * w, y + h / 2)
    window.mouse("Pressed", x + start * w, y + h / 2, held=True)
    for part in np.linspace(start, end, 5):
        window.mouse("Moved", x + part * w, y + h / 2, held=True)
    window.mouse("Released", x + end * w, y + h / 2, held=True)


@pytest.mark.parametrize("width", [1200, 400])
@pytest.mark.parametrize("dark", [False, True])
def test_nothing_overlaps_and_nothing_fails(window, report, width, dark):
    window.size(width)
    window.dark(dark)
    window.open(report)
    window.value("new Promise(requestAnimationFrame)")
    wide, seen = window.value("(d => [d.scrollWidth, d.clientWidth])(document.documentElement)")
    assert wide <= seen == width
    assert not window.problems
    paper = window.value("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", paper))) < 200) == dark
    assert window.value("document.querySelectorAll('figure.drawn canvas').length") >= 2
    # A table wider than the page scrolls, with a hint until its end.
    table = "document.querySelector('[aria-label=Estimates]')"
    more = f"{table}.classList.contains('more')"
    window.until(f"{more} === ({table}.scrollWidth > {table}.clientWidth + 2)")
    assert window.value(more) == (width == 400)
    window.value(f"{table}.scrollLeft = 9999")
    window.until(f"!{more}")


def test_zoom_and_hover_move_all_time_histories_together(window, report):
    window.size(1200)
    window.open(report)
    group = over_time(window)
    first = f"heliCharts.groups.get({json.dumps(group)})[0]"
    low, high = scales(window, group)
    drag(window, first, 0.25, 0.5)
    window.until(f"{first}.scales.x.max < {high - 1}")
    zoomed = scales(window, group)
    quarter = np.array([0.75 * low + 0.25 * high, 0.5 * (low + high)])
    assert zoomed == pytest.approx(quarter, abs=0.02 * (high - low))
    for k in range(window.value(f"heliCharts.groups.get({json.dumps(group)}).length")):
        assert scales(window, group, k) == pytest.approx(zoomed, abs=0.03 * (high - low))
    # A hover shows the measured value, in the table below the panel.
    x, y = window.value(
        f"(r => [r.x + r.width / 2, r.y + 20])({first}.over.getBoundingClientRect())"
    )
    window.mouse("Moved", x, y)
    legend = window.value(f"{first}.root.querySelector('.u-legend').textContent")
    measured = float(re.search(r"measured:?\s*([−\d.]+) rad", legend)[1].replace("−", "-"))
    k = window.value(f"{first}.cursor.idx")
    assert measured == pytest.approx(window.value(f"{first}.data[1][{k}]"), abs=1e-4)
    others = window.value(
        f"heliCharts.groups.get({json.dumps(group)}).map(u => u.cursor.left >= 0)"
    )
    assert all(others)
    assert not window.problems


def test_charts_answer_to_keys(window, report):
    window.size(1200)
    window.open(report)
    group = over_time(window)
    low, high = scales(window, group)
    window.value("document.querySelector('.live').focus()")
    window.press("+")
    a, b = scales(window, group)
    assert b - a == pytest.approx(0.5 * (high - low), rel=0.01)
    window.press("ArrowRight")
    spoken = window.value("document.querySelector('.live [role=status]').textContent")
    assert "measured" in spoken
    assert re.search(r"\d", spoken)
    window.press("0")
    assert scales(window, group) == pytest.approx([low, high], abs=1e-6)
    assert not window.problems


def test_tables_copy_as_latex_and_where_there_is_no_clipboard(window, report):
    window.open(report)
    tex = window.value("heliTables.tex(document.querySelector('.wide > table'))")
    assert r"\begin{tabular}{lrr" in tex
    assert r"$\cdot 10^{-4}$" in tex
    # A page opened as a file may have no clipboard: then the text is shown and selected.
    window.value("Object.defineProperty(navigator, 'clipboard', {value: undefined})")
    window.value("document.execCommand = () => false")
    window.value("document.querySelector('.copy button').click()")
    window.until("document.querySelector('.copy textarea')?.value.startsWith('parameter')")
    assert not window.problems


def test_a_copied_table_is_numbers_to_a_spreadsheet(window, report):
    window.open(report)
    first = window.value("heliTables.csv(document.querySelector('.wide > table'))")
    [estimate, *_] = csv.DictReader(first.splitlines())
    texts = {"parameter", "unit", "at bound"}
    numbers = {k: float(v) for k, v in estimate.items() if k not in texts and v}
    interval = [numbers[k] for k in numbers if k.endswith((", from", ", to"))]
    assert interval[0] < numbers["estimate"] < interval[1]
    part = numbers["sd"] / numbers["estimate"]
    assert numbers["sd / value [%]"] == pytest.approx(100 * part, rel=0.1)
    table = """
        <thead><tr><th><th>fit<th>a<th>rmse<th>mixed<tbody>
        <tr><th>x<td>−1.2·10⁻³ ± 0.1·10⁻³<td>6 (5 to 7), 1 Hz<td>8.7 deg<td>1 of 2
        <tr><th>y<td>not determined<td>–<td>2 m/s<td>3"""
    of_others = window.value(
        "heliTables.csv(Object.assign(document.createElement('table'), "
        f"{{ innerHTML: `{table}` }}))"
    )
    assert list(csv.reader(of_others.splitlines())) == [
        ["", "fit", "fit, sd", "a", "a, from", "a, to", "a, also", "rmse", "rmse, unit", "mixed"],
        ["x", "-1.2e-3", "0.1e-3", "6", "5", "7", "1 Hz", "8.7", "deg", "1 of 2"],
        ["y", "not determined", "", "", "", "", "", "2", "m/s", "3"],
    ]


def test_all_of_it_is_printed(window, report):
    window.size(1200)
    window.open(report)
    # This handler runs after the page's.
    count = "document.querySelectorAll('details:not([open])').length"
    assert window.value(count) > 0
    window.value(f"addEventListener('beforeprint', () => {{ window.folded = {count}; }})")
    assert window.pdf().startswith(b"%PDF")
    assert window.value("window.folded") == 0
    assert window.value(count) > 0
    window.call("Emulation.setEmulatedMedia", media="print")
    assert window.value("document.querySelector('.live').offsetWidth")
    window.call("Emulation.setEmulatedMedia", media="")
    assert not window.problems


def test_verdict_estimates_worst_output_and_findings_are_on_the_first_screen(window, report):
    window.size(1280)
    window.open(report)
    bottom = "document.querySelector('.first').getBoundingClientRect().bottom"
    assert window.value(bottom) <= 800
