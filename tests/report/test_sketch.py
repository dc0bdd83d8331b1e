"""Figures without Matplotlib: the same charts as with it, which is the oracle here."""

import dataclasses
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from heli_jax.analysis.flight_responses import Settings
from heli_jax.identification.result import StartRow
from heli_jax.report import figures, style
from heli_jax.report.charts import chart_of
from heli_jax.report.drawings import Analysis, drawings
from heli_jax.report.files import SupplementaryAnalyses
from heli_jax.report.fitted_responses import fitted_responses
from heli_jax.report.matrix_svg import correlation_svg
from heli_jax.report.sketch import Sketch
from heli_jax.report.svg import chart_svg


def alike(one, other):
    """Whether two charts are the same, numbers to rounding and heights to a pixel."""
    assert one._replace(panels=()) == other._replace(panels=())
    for a, b in zip(one.panels, other.panels, strict=True):
        assert (a.label, a.levels, a.marks, a.shades) == (b.label, b.levels, b.marks, b.shades)
        np.testing.assert_allclose(a.limits, b.limits, rtol=1e-9, atol=1e-300)
        np.testing.assert_allclose(a.x_limits, b.x_limits, rtol=1e-12)
        assert abs(a.height - b.height) <= 1
        for s, t in zip(a.series, b.series, strict=True):
            assert s[:5] == t[:5]
            for v, w in zip(s[5:], t[5:], strict=True):
                assert (v is None) == (w is None)
                if v is not None:
                    np.testing.assert_allclose(v, w, rtol=1e-9, atol=1e-12)


def gone(fit, problem):
    """The fit with a gap in what was measured, and a simulation that ran away."""
    s = fit.signals[0]
    measured = {n: np.where(np.arange(y.size) % 7 < 3, np.nan, y) for n, y in s.measured.items()}
    ran = {n: y * np.exp(np.linspace(0.0, 600.0, y.size)) for n, y in s.simulated.items()}
    signals = (s._replace(measured=measured, simulated=ran),)
    return dataclasses.replace(fit, signals=signals), problem, None


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.parametrize("change", [None, gone])
def test_a_sketch_gives_the_chart_that_matplotlib_gives(sound, change):
    fit, problem, baseline = change(*sound[:2]) if change else sound
    more = SupplementaryAnalyses()
    if change is None:
        more = SupplementaryAnalyses(
            responses=fitted_responses(fit, problem, Settings(window=10.0), ())
        )
    compared = []
    for name, draw in drawings(Analysis(fit, problem, baseline, more)).items():
        if draw.chart is None or name == "starts":
            continue
        chart, drawn = draw.chart(), style.styled(draw)
        alike(chart, chart_of(drawn))
        compared.append(name.partition("_")[0])
    expected = {"response", "residual", "bode"} | (set() if change else {"match", "rls"})
    assert set(compared) == expected


@pytest.mark.parametrize(
    "y", [[], [0.0, 0.0], [3.0, 3.0], [-2.0, -2.0], [np.nan, 1.0], [1e300, -1e300], [np.nan]]
)
def test_limits_that_none_sets_are_matplotlib_s(y):
    x, y = np.arange(float(len(y))), np.array(y, float)
    with style.in_style(), np.errstate(over="ignore"):
        ax = style.figure(2.0).subplots()
        ax.plot(x, y)
        expected = ax.get_ylim()
    [sketched] = Sketch().panels([1.0])
    sketched.plot(x, y, color="#000000")
    np.testing.assert_allclose(sketched.get_ylim(), expected, rtol=1e-12)


def test_a_default_page_needs_no_matplotlib():
    said = (
        "import sys, heli_jax.workflow, heli_jax.report.html; "
        "print([m for m in ('matplotlib', 'PIL', 'pandas', 'xarray') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def rows(*starts):
    return tuple(StartRow({}, {}, cost, 1, ok, k) for cost, ok, k in starts)


def test_starts_have_a_colour_for_each_optimum_and_one_for_failure():
    chart = figures.waterfall_chart(
        rows((1.02, True, 2), (1.0, True, 1), (np.inf, False, 0), (1.0, True, 1))
    )
    [panel] = chart.panels
    points = {s.label: (s.x.tolist(), s.color) for s in panel.series if s.kind == "points"}
    assert points == {
        "optimum 1": ([1.0, 2.0], style.BLUE),
        "optimum 2": ([3.0], style.GREEN),
        "failed": ([4.0], style.VERMILLION),
    }
    assert chart.note.startswith("starts that ended without a finite cost")
    low, high = panel.limits
    assert all(low < v < high for s in panel.series for v in s.y)
    # Starts are counted: half a start is no place on the axis.
    drawing = chart_svg(chart).text
    assert ">1<" in drawing
    assert ">1.5<" not in drawing


def test_costs_of_several_decades_are_shown_by_their_logarithm():
    [panel] = figures.waterfall_chart(rows((1.0, True, 1), (1e4, True, 2))).panels
    assert panel.label == "log10 of the cost"
    assert panel.series[0].y.tolist() == [0.0, 4.0]


def test_one_start_has_no_chart():
    assert figures.waterfall_chart(rows((1.0, True, 1))) is None


def test_the_matrix_has_a_cell_for_each_pair_within_its_image(sound):
    verdict = sound[0].verdict
    title, drawing = correlation_svg(verdict)
    assert title == "Correlation of the estimates"
    n = len(verdict.names)
    root = ET.fromstring(drawing.text)  # also: it is well-formed
    cells = [e for e in root.iter() if e.tag.endswith("rect") and "x" in e.attrib]
    assert len(cells) == n * n
    assert all(float(c.attrib["x"]) + float(c.attrib["width"]) <= drawing.size[0] for c in cells)
    words = [e.text for e in root.iter() if e.tag.endswith("text")]
    assert words.count("1") == n
    assert all(words.count(name) == 2 for name in verdict.names)


def test_names_of_a_matrix_are_escaped_and_many_of_them_fit(sound):
    verdict = sound[0].verdict
    names = tuple(f"<{k}>&a_long_name" for k in range(40))
    r = np.eye(40)
    r[0, 1] = r[1, 0] = -0.9999
    r[2, 3] = np.nan
    _, drawing = correlation_svg(dataclasses.replace(verdict, names=names, correlation=r))
    root = ET.fromstring(drawing.text)
    cells = [e for e in root.iter() if e.tag.endswith("rect") and "x" in e.attrib]
    assert max(float(c.attrib["x"]) + float(c.attrib["width"]) for c in cells) <= drawing.size[0]
    assert "−0.99990" in drawing.text
    assert "nan" not in drawing.text
