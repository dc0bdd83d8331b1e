"""A chart as SVG: what is drawn lies where the data say, in text that any program reads."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heli_jax.report import svg
from heli_jax.report.charts import Chart, Panel, Series
from heli_jax.report.embedded import Numbers
from heli_jax.report.figures.panels import panels
from heli_jax.report.pictures import picture
from heli_jax.report.ticks import decades, tick_texts, ticks

SVG = "{http://www.w3.org/2000/svg}"


def line(x, y, kind="line", label="", **more):
    return Series(
        label, kind, "#0072B2", 1.0, False, np.asarray(x, float), np.asarray(y, float), **more
    )


def chart(*series, limits=(0.0, 10.0), x_limits=(0.0, 4.0), logarithmic=False, **more):
    # Too low for its label in one line.
    panel = Panel("roll & <pitch> [rad]", limits, 100.0, series, **more)
    return Chart("A <title>", "a note", "time [s]", logarithmic, x_limits, (panel,))


def parsed(drawn):
    return ElementTree.fromstring(svg.chart_svg(drawn).text)


def points(path):
    """The corners of a path of M, L and l, [pixel]."""
    at, corners = np.zeros(2), []
    for what, numbers in re.findall(r"([MLl])([^MLlz]+)", path):
        pair = np.array([float(v) for v in re.findall(r"-?[\d.]+", numbers)])
        at = pair if what in "ML" else at + pair
        corners.append(at)
    return np.array(corners)


def drawn_lines(root):
    return [
        p.attrib["d"]
        for g in root.iter(f"{SVG}g")
        for p in g.iter(f"{SVG}path")
        if p.attrib.get("stroke") == "#0072B2"
    ]


def test_a_line_goes_where_its_numbers_are():
    [path] = drawn_lines(parsed(chart(line([0, 1, 2, 4], [0, 10, 5, 2.5]))))
    at = points(path)
    # Both axes are linear: the same share of the way between the ends.
    np.testing.assert_allclose(
        (at[:, 0] - at[0, 0]) / np.ptp(at[:, 0]), [0, 0.25, 0.5, 1], atol=1e-3
    )
    np.testing.assert_allclose((at[0, 1] - at[:, 1]) / 100.0, [0, 1, 0.5, 0.25], atol=2e-3)


def test_equal_factors_are_equal_distances_on_a_logarithmic_axis():
    drawn = chart(line([1, 10, 100], [1, 1, 1]), x_limits=(1.0, 100.0), logarithmic=True)
    [path] = drawn_lines(parsed(drawn))
    assert np.diff(points(path)[:, 0], 2) == pytest.approx(0.0, abs=0.2)


def test_what_is_missing_breaks_the_line_and_nothing_is_not_a_number():
    [path] = drawn_lines(parsed(chart(line([0, 1, 2, 3, 4], [1, 2, np.nan, 2, 1]))))
    assert path.count("M") == 2
    text = svg.chart_svg(chart(line([0, 1], [np.nan, np.nan]), line([0, 1], [np.inf, 1e300]))).text
    assert "nan" not in text
    assert "inf" not in text


def test_words_are_escaped_and_lines_named():
    root = parsed(chart(line([0, 1], [0, 1], label="a<b"), line([0, 1], [1, 0], label="fit")))
    words = [t.text for t in root.iter(f"{SVG}text")]
    assert {"A <title>", "a note", "roll & <pitch>", "[rad]", "time [s]", "a<b", "fit"} <= set(
        words
    )


def test_bars_bands_steps_marks_and_shades_are_drawn():
    x, y = np.arange(4.0), np.array([1.0, 2.0, 3.0, 4.0])
    series = [line(x, y, k, low=y - 1, high=y + 1) for k in ("bars", "band")]
    drawn = chart(*series, line(x, y, "step"), levels=(5.0,), marks=(2.0,), shades=((1.0, 2.0),))
    text = svg.chart_svg(drawn).text
    assert text.count("h0") == 4
    assert re.search(r"M[\d.]+ [\d.]+h[\d.]+v-[\d.]+", text)
    assert "#E69F00" in text
    assert "z" in text


def test_a_peak_of_one_sample_in_a_long_record_is_seen():
    y = np.zeros(100_000)
    y[54_321] = 9.0
    [path] = drawn_lines(parsed(chart(line(np.linspace(0, 4, y.size), y))))
    at = points(path)
    assert np.ptp(at[:, 1]) == pytest.approx(90.0, abs=0.2)
    assert len(path) < 20_000


@given(
    low=st.floats(-1e12, 1e12),
    span=st.floats(1e-9, 1e12),
    most=st.integers(3, 12),
    degrees=st.booleans(),
)
def test_ticks_lie_within_the_axis_and_are_told_apart(low, span, most, degrees):
    high = low + max(span, 1e-6 * abs(low))
    values = ticks(low, high, most, degrees=degrees)
    assert 2 <= len(values) <= most
    hair = 1e-6 * (high - low)
    assert all(low - hair <= v <= high + hair for v in values)
    assert len(set(tick_texts(values))) == len(values)


def test_a_low_panel_has_a_number_besides_zero():
    assert ticks(-0.45, 0.45, 3) == pytest.approx([-0.4, 0.0, 0.4])


def test_phases_are_numbered_in_parts_of_a_right_angle():
    assert ticks(-210.0, 20.0, 6, degrees=True) == [-180.0, -135.0, -90.0, -45.0, 0.0]
    assert ticks(-100.0, 60.0, 3, degrees=True) == [-90.0, 0.0]
    assert ticks(-12.0, 11.0, 6, degrees=True) == [-10.0, -5.0, 0.0, 5.0, 10.0]
    assert ticks(-2000.0, 100.0, 6, degrees=True) == [-1800.0, -1440.0, -1080.0, -720.0, -360.0, 0]


def test_numbers_of_an_axis_are_written_as_elsewhere_on_the_page():
    assert tick_texts([-2e-6, 0.0, 2e-6]) == ["−2·10⁻⁶", "0", "2·10⁻⁶"]
    assert tick_texts([0.0, 0.05, 0.1]) == ["0.00", "0.05", "0.10"]
    assert decades(0.3, 20.0, 9) == pytest.approx([0.5, 1, 2, 5, 10, 20])
    assert decades(1e-4, 1e4, 9) == pytest.approx([10.0**k for k in range(-4, 5)])


def test_png_files_are_written_where_they_are_asked_for(tmp_path):
    def draw():
        [ax] = panels(None, 2.0, [1.0])
        ax.plot([0, 1], [0, 1])
        return ax.figure

    for png, suffixes in ((False, {".svg"}), (True, {".svg", ".png"})):
        folder = tmp_path / str(png)
        folder.mkdir()
        picture("one", draw, Numbers(), folder=folder, png=png)
        assert {p.suffix for p in folder.iterdir()} == suffixes
