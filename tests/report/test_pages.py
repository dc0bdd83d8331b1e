"""Common parts of pages: log time, readable numbers, equal numbers for equal things."""

import csv

import numpy as np
import pytest

from heli_jax import compare_runs, models
from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import whiteness
from heli_jax.numbers import percent
from heli_jax.report import compared_runs, figures
from heli_jax.report.files import write_signals
from heli_jax.report.saved_fit import load_fit
from tests.report.test_compared_runs import write_run


def part(name, start, n=300):
    """Return a part of a log that begins `start` seconds into it."""
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(n)
    y = rng.standard_normal(n)
    u = {"x_roll": np.sign(np.sin(t))}
    return Signals(name, False, t, u, {"roll": y}, {"roll": 0.0 * y}, log_start=start)


def test_the_time_of_the_log_is_kept_in_the_table_and_read_back(tmp_path):
    folder = write_run(tmp_path / "run", {"Ixx": (0.02, 0.001)}, metrics={"roll": {}})
    write_signals(folder / "signals.csv", (part("part 1", 0.0), part("part 2", 42.0001)))
    rows = list(csv.DictReader((folder / "signals.csv").read_text().splitlines()))
    second = [row for row in rows if row["flight"] == "part 2"]
    assert (float(second[0]["time"]), float(second[0]["log_time"])) == (0.0, 42.0001)
    assert float(second[-1]["log_time"]) == pytest.approx(42.0001 + 299 * 0.02, abs=1e-12)
    # A time is not an input of the model.
    assert list(second[0])[:4] == ["flight", "time", "log_time", "x_roll"]


def test_a_saved_run_has_the_time_of_its_log(tmp_path):
    folder = write_run(tmp_path / "run", {"Ixx": (0.02, 0.001)})
    of_p = part("flight 1", 42.0)._replace(
        measured={"p": np.ones(300)}, simulated={"p": np.ones(300)}
    )
    write_signals(folder / "signals.csv", (of_p,))
    [signals] = load_fit(folder).signals
    assert signals.log_start == pytest.approx(42.0)
    assert list(signals.inputs) == ["x_roll"]
    # From an earlier version, whose tables had no such column.
    [older] = load_fit(write_run(tmp_path / "old", {"Ixx": (0.02, 0.001)})).signals
    assert older.log_start is None


def test_figures_over_time_are_in_log_time_and_two_parts_share_no_cursor():
    charts = [
        figures.response(part(n, s), "roll", models.roll_on_stand)
        for n, s in (("part 1", 0.0), ("part 2", 42.0))
    ]
    assert [c.x_label for c in charts] == ["time in the log [s]"] * 2
    assert charts[1].x_limits == pytest.approx((42.0, 42.0 + 299 * 0.02))
    assert charts[1].panels[0].series[0].x[0] == 42.0
    assert charts[0].of != charts[1].of


def test_card_and_figure_give_one_number_where_samples_are_missing():
    signals = part("one", 0.0)
    signals.measured["roll"][100:160] = np.nan
    test = whiteness(signals.measured["roll"])
    chart = figures.residual_correlation(signals, "roll", test=test)
    assert f"{percent(test.outside, 1)} of {test.lags} lags" in chart.note
    # The number counts the stems drawn outside the band.
    inside, outside = (s.y.size for s in chart.panels[0].series[1:])
    assert outside / (inside + outside) == pytest.approx(test.outside)


def test_runs_side_by_side_have_files_and_configurations(tmp_path):
    for name in "ab":
        folder = write_run(tmp_path / name, {"Ixx": (2.0e-5, 1e-6)})
        (folder / "config.yaml").write_text(f"model: <{name}>\n")
    page = tmp_path / "pages" / "out.html"
    page.parent.mkdir()
    compared_runs.write_page(page, compare_runs([tmp_path / n for n in "ab"]))
    html = page.read_text()
    assert '<a href="../a/fit.json">fit.json</a>' in html
    assert "model: &lt;b&gt;" in html
    assert "2.00·10⁻⁵ ± 0.10·10⁻⁵" in html
    assert "kg m²" in html
