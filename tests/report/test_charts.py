"""Figures as plain data, and the data that a page embeds."""

import base64
from xml.etree import ElementTree

import numpy as np
import pytest

from heli_jax import models
from heli_jax.identification.result import Signals
from heli_jax.report import figures, origin, style
from heli_jax.report.charts import (
    Chart,
    Numbers,
    band,
    bars,
    described,
    panel,
)
from heli_jax.report.page import picture


def decoded(content, number):
    """Return an array of a page, decoded by hand."""
    a = content["arrays"][number]
    if "n" in a:
        return a["from"] + a["step"] * np.arange(a["n"])
    if "f" in a:
        return np.frombuffer(base64.b64decode(a["f"]), "<f4").astype(float)
    parts = np.frombuffer(base64.b64decode(a["q"]), "<u2")
    return np.where(parts == 65535, np.nan, a["low"] + a["step"] * parts)


def record(n, outputs=1, inputs=4):
    """Return n samples at 100 Hz, all noise, which images cannot compress."""
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(n)
    names = ("roll", "pitch", "yaw", "z", "dz")[:outputs]
    y = {m: np.sin(t) + 0.3 * rng.standard_normal(n) for m in names}
    u = {m: rng.standard_normal(n) for m in ("x_roll", "x_pitch", "x_yaw", "x_throttle")[:inputs]}
    return Signals("one", False, t, u, y, {m: np.sin(t) for m in names})


def test_a_chart_has_all_points_its_file_fewer_and_words_its_range():
    signals = record(5000)
    signals.measured["roll"][100:120] = np.nan
    chart = figures.response(signals, "roll", models.by_name("helicopter"))
    assert chart.x_label == "time [s]"
    assert [p.label for p in chart.panels[:2]] == ["roll [rad]", "residual [rad]"]
    measured, simulated = chart.panels[0].series
    assert (measured.label, simulated.label) == ("measured", "simulated")
    np.testing.assert_array_equal(measured.y, signals.measured["roll"])
    assert chart.panels[1].levels == (0.0,)
    assert chart.panels[2].series[0].kind == "step"
    drawn = style.styled(lambda: chart)
    assert drawn.axes[0].get_lines()[0].get_xdata().size <= 800
    words = described(chart)
    low, high = np.nanmin(measured.y), np.nanmax(measured.y)
    assert f"measured −{-low:.3g} to {high:.3g}" in words
    assert "0 to 50" in words


def test_bars_and_bands_are_drawn_where_they_are():
    x, y = np.arange(1.0, 6.0), np.array([1.0, 3.0, 2.0, 5.0, 4.0])
    series = [
        band(x, y - 0.5, y + 1.5, style.SKY),
        bars("data", x, y, [0.1 * y, 0.2 * y], style.BLUE),
    ]
    only = panel("y", series)
    np.testing.assert_allclose([series[1].low, series[1].high], [0.9 * y, 1.2 * y])
    [ax] = style.styled(lambda: Chart("t", "x", (1.0, 5.0), (only,))).axes
    assert ax.get_ylim() == pytest.approx((0.5 - 0.05 * 6.0, 6.5 + 0.05 * 6.0))
    [shade] = ax.collections
    extent = shade.get_datalim(ax.transData)
    assert (extent.y0, extent.y1) == pytest.approx((0.5, 6.5))
    points, ends = ax.get_lines()
    np.testing.assert_allclose(points.get_ydata(), y)
    np.testing.assert_allclose(ends.get_ydata()[:2], [0.9, 1.2])


NAMES = ["$a_1^$ <b> & \\frac{", "bell\x07 and\x1b[31m"]


@pytest.mark.parametrize("name", NAMES)
def test_words_from_a_log_stay_words_and_files_are_the_same_each_time(tmp_path, name):
    x = np.arange(1.0, 4.0)
    made = panel("y", [bars("", x, np.ones(3), np.ones(3), style.BLUE)])
    chart = Chart(name, "x", (1.0, 3.0), (made,))
    files = []
    for png in (False, True):
        folder = tmp_path / str(png)
        folder.mkdir()
        picture("one", lambda: chart, Numbers(), folder=folder, png=png)
        assert {p.suffix for p in folder.iterdir()} == ({".svg", ".png"} if png else {".svg"})
        files.append((folder / "one.svg").read_bytes())
    assert files[0] == files[1]
    words = [e.text for e in ElementTree.fromstring(files[0]).iter() if e.tag.endswith("text")]
    assert "".join(c for c in name if c.isprintable()) in words


def test_numbers_come_back_to_a_hundredth_of_a_percent_of_their_range():
    rng = np.random.default_rng(1)
    values = rng.standard_normal(500)
    values[::7] = np.nan
    numbers = Numbers()
    once, again = numbers.array(values), numbers.array(values.copy())
    times, constant = numbers.array(3.0 + 0.02 * np.arange(400)), numbers.array(np.full(9, 2.5))
    content = numbers.content()
    assert once == again
    back = decoded(content, once)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    assert np.nanmax(np.abs(back - values)) < 1e-5 * np.ptp(values[np.isfinite(values)])
    np.testing.assert_allclose(decoded(content, times), 3.0 + 0.02 * np.arange(400), atol=1e-12)
    np.testing.assert_array_equal(decoded(content, constant), 2.5)


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["/opt/bin/heli-jax", "fit", "a b.yaml"], "heli-jax fit 'a b.yaml'"),
        (["/opt/x/heli_jax/__main__.py", "check"], "heli-jax check"),
        (["work/fit.py", "1"], "python fit.py 1"),
        (["/opt/ipykernel_launcher.py", "-f", "/home/me/k.json"], "in a notebook"),
        ([""], "in a Python session"),
    ],
)
def test_the_command_is_named_without_its_place(monkeypatch, words, command):
    monkeypatch.setattr(origin.sys, "argv", words)
    assert origin.origin().command == command
