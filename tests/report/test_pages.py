"""What all pages share: log time, numbers that can be read, one number for one thing."""

import csv
import math

import numpy as np
import pytest

from heli_jax import compare_runs, models
from heli_jax.flights.flight import Signal
from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import whiteness
from heli_jax.numbers import percent
from heli_jax.report import compared_page, drawings, figures
from heli_jax.report.files import write_signals
from heli_jax.report.saved_fit import load_fit
from tests.report.test_compared_runs import METRICS, write_run


def part(name, start, n=300):
    """A part of a log that begins `start` seconds into it."""
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
    # A time is no input of the model.
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
    # Of an earlier version, whose tables had no such column.
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
    # The stems that are drawn outside the band are those that the number counts.
    inside, outside = (s.y.size for s in chart.panels[0].series[1:])
    assert outside / (inside + outside) == pytest.approx(test.outside)


def test_a_pulse_width_is_shown_as_logged_beside_si():
    pwm = Signal("aileron_pwm", "m", "m", offset=1496.0, scale=6e-9, invert=True)
    as_logged = drawings.as_logged(pwm)
    assert as_logged is not None
    x = 6e-9 * (1496.0 - 1436.0)  # the log's 1436, inverted
    assert x * as_logged.factor + as_logged.offset == pytest.approx(1436.0)
    assert as_logged.unit == "aileron_pwm"
    assert drawings.as_logged(Signal("roll", "rad", "rad")) is None
    degrees = drawings.as_logged(Signal("roll", "deg", "rad"))
    assert degrees == ("deg", pytest.approx(180.0 / math.pi), 0.0)


@pytest.mark.parametrize(("window", "drawn"), [([18.0, 32.0], True), ([18.0, 30.0], False)])
def test_one_part_of_a_log_is_overlaid_whatever_the_runs_call_it(tmp_path, window, drawn):
    held = part("flight 1", 7.0, 200)
    flights = [("a", "flight 1", [18.0, 32.0]), ("b", "doublets", window)]
    for run, name, seconds in flights:
        data = [{"flight": name, "hold_out": False, "sha256": "a", "window": seconds}]
        agreed = {"roll": METRICS}
        folder = write_run(tmp_path / run, {"Ixx": (2.0e-5, 1e-6)}, data=data, metrics=agreed)
        write_signals(folder / "signals.csv", (held._replace(flight=name),))
    compared_page.write_page(tmp_path / "out.html", compare_runs([tmp_path / n for n in "ab"]))
    html = (tmp_path / "out.html").read_text()
    assert ("Simulated over measured" in html) == drawn
    assert ("No responses are overlaid" in html) != drawn


def test_runs_side_by_side_have_files_configurations_and_responses(tmp_path):
    rng = np.random.default_rng(0)
    u, held = rng.standard_normal(4000), part("flight 1", 7.0, 4000)
    for name, gain in (("a", 1.0), ("b", 2.0)):
        one_log = [{"flight": "flight 1", "hold_out": False, "sha256": "a"}]
        folder = write_run(tmp_path / name, {"Ixx": (2.0e-5, 1e-6)}, data=one_log)
        (folder / "config.yaml").write_text(f"model: <{name}>\n")
        y = np.convolve(u, [0.5, 0.3, 0.2])[:4000]
        run = held._replace(inputs={"lat": u}, measured={"p": y}, simulated={"p": gain * y})
        write_signals(folder / "signals.csv", (run,))
    third = write_run(tmp_path / "c", {"Ixx": (2.0e-5, 1e-6)})
    text = (third / "signals.csv").read_text().replace("flight 1", "other")
    (third / "signals.csv").write_text(text)
    compared = compare_runs([tmp_path / n for n in "abc"])
    page = tmp_path / "pages" / "out.html"
    page.parent.mkdir()
    compared_page.write_page(page, compared)
    html = page.read_text()
    assert '<a href="../a/fit.json">fit.json</a>' in html
    assert "model: &lt;b&gt;" in html
    assert "Not drawn: c (no p of that log in a flight named flight 1, or no result)." in html
    assert "2.00·10⁻⁵ ± 0.10·10⁻⁵" in html
    assert "kg m²" in html
