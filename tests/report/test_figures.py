"""Figures: no empty panel, no lost peak, correct bands, continuous phase."""

import matplotlib
import matplotlib.image
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heli_jax.identification.fit import Signals
from heli_jax.identification.validation.metrics import lags_for
from heli_jax.report import figures, style
from heli_jax.report.charts import thinned
from heli_jax.report.figures.bode import baseline_response, phase
from tests.responses import continuous


def noise_signals(n=900, inputs=("x_roll",), seed=0):
    rng = np.random.default_rng(seed)
    u = {name: np.repeat(rng.standard_normal(n // 10 + 1), 10)[:n] for name in inputs}
    y = rng.standard_normal(n)
    return Signals("one", False, 0.02 * np.arange(n), u, {"roll": y}, {"roll": np.zeros(n)})


@given(
    st.integers(1, 5000),
    st.integers(4, 400),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["normal", "steps", "constant"]),
)
def test_thinning_keeps_extremes_ends_and_order(n, most, seed, kind):
    rng = np.random.default_rng(seed)
    y = {
        "normal": rng.standard_normal(n),
        "steps": np.round(rng.standard_normal(n)),
        "constant": np.ones(n),
    }[kind]
    x = np.arange(n, dtype=float)
    tx, ty = thinned(x, y, most)
    assert tx.size == ty.size <= max(most, 4)
    assert ty.max() == y.max()
    assert ty.min() == y.min()
    assert (tx[0], tx[-1]) == (x[0], x[-1])
    assert np.all(np.diff(tx) > 0)
    assert np.array_equal(ty, y[tx.astype(int)])


@pytest.mark.parametrize("n", [40, 900, 6000])
def test_residual_bands_and_lags(n):
    chart = figures.residual_correlation(noise_signals(n), "roll")
    band, lags = 2.5758 / np.sqrt(n), lags_for(n)
    for panel in chart.panels:
        assert panel.series[0].high == pytest.approx(
            np.full(panel.series[0].x.size, band), rel=1e-3
        )
        assert panel.series[0].low == pytest.approx(-panel.series[0].high)
    drawn = np.sort(np.concatenate([s.x for s in chart.panels[0].series[1:]]))
    assert drawn == pytest.approx(0.02 * np.arange(1, lags + 1))
    assert chart.x_limits == pytest.approx((-0.02 * (lags + 0.5), 0.02 * (lags + 0.5)))


def test_residual_that_follows_the_input_stands_out_at_its_lag():
    s = noise_signals()
    late = np.roll(s.inputs["x_roll"], 7)
    s = s._replace(measured={"roll": s.measured["roll"] + 5.0 * late})
    outside = figures.residual_correlation(s, "roll").panels[1].series[2]
    assert outside.x[np.argmax(outside.y)] == pytest.approx(7 * 0.02)


def test_every_figure_has_something_in_it(sound, tmp_path):
    fit, problem, baseline = sound
    s = fit.signals[0]
    drawn = {
        "response": figures.response(s, "roll", problem.model),
        "residual": figures.residual_correlation(s, "roll"),
        "rls": figures.rls_history(baseline),
    }
    for name, made in drawn.items():
        svg = style.save(lambda made=made: made, tmp_path / name)
        assert svg is not None
        assert svg.count(b"<path") + svg.count(b"<text") > 10
        assert len(svg) < 400_000
        pixels = matplotlib.image.imread(tmp_path / f"{name}.png")[..., :3]
        assert pixels.std() > 0.02


def test_the_baseline_s_response_is_drawn_without_its_hold(sound):
    fit, problem, baseline = sound
    omega = np.geomspace(1.0, 6.0, 20)
    H = continuous(problem.model, fit.params, "roll", "x_roll")(omega)
    ratio = baseline_response(baseline, omega) / H
    # Half a sample of delay at 6 rad/s would be 8.6 deg.
    assert np.max(np.abs(np.degrees(np.angle(ratio)))) < 5.0
    assert np.abs(ratio) == pytest.approx(np.ones(20), abs=0.15)


def test_phase_begins_on_one_branch():
    turns = np.exp(1j * np.radians(np.linspace(-180.0, -900.0, 200)))
    assert phase(turns)[0] == pytest.approx(-180.0)
    assert phase(turns)[-1] == pytest.approx(-900.0)
    assert phase(-turns)[0] == pytest.approx(0.0, abs=1e-9)
