"""Windows of a record: the excited part is chosen, damaged parts are left out."""

from dataclasses import replace

import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.cli import main
from heli_jax.config import load
from heli_jax.config import problem as configured
from heli_jax.errors import InputError
from heli_jax.flights import Source
from heli_jax.flights.parts import part
from heli_jax.identification.design.windows import why_excluded
from heli_jax.identification.fit import check, windows
from tests.identification.test_enough import DT, problem, response, steps


def excited(first, last, n=2000, seed=0):
    """Return forty seconds, with the stick at rest except in one part."""
    rng = np.random.default_rng(seed)
    u = np.zeros(n)
    u[first:last] = steps(rng, last - first)
    phi, _ = response(u, np.zeros(n))
    y = phi + 0.005 * rng.standard_normal(n)
    return Flight(dt=DT, inputs={"u": u, "v": np.zeros(n)}, outputs={"phi": y}, sd={"phi": 0.005})


@pytest.fixture(scope="module")
def ranked():
    return windows(problem(excited(800, 1200)), 4.0)


def test_the_excited_part_is_found(ranked):
    assert ranked.parameters == ("k", "d", "b")
    # The remaining motion after 24 s has some information about the damping.
    for choice in ranked.taken:
        assert choice.window.start < 25.0
        assert choice.window.end > 16.0
    assert ranked.taken[0].window.sd.max() < 0.2
    assert ranked.taken[-1].efficiency >= 0.9
    assert [c.efficiency for c in ranked.taken] == sorted(c.efficiency for c in ranked.taken)
    still = [w for w in ranked.windows if w.end < 15.0]
    assert still
    assert all(w.sd[2] > 1.0 for w in still)
    assert [w.last for w in ranked.windows[:-1]] == [w.first for w in ranked.windows[1:]]


@pytest.mark.slow
def test_the_expected_sd_is_that_of_a_check_of_the_window_alone(ranked):
    whole = excited(800, 1200)
    # A window that begins at rest, as in `check`.
    [window] = [w for w in ranked.windows if w.first == 800]
    alone = part(whole, window.first, window.last)
    sd = np.sqrt(np.diag(check(problem(alone)).verdict.covariance))
    np.testing.assert_allclose(window.sd, sd, rtol=0.1)


def test_windows_of_a_part_count_from_the_beginning_of_its_log():
    late = replace(excited(100, 400, 500), t0=112.0, source=Source("log", "0", first_time=100.0))
    second = windows(problem(late), 2.0).windows[1]
    assert (second.start, second.end) == pytest.approx((14.0, 15.98))


@pytest.mark.slow
def test_no_part_says_more_than_the_whole(ranked):
    whole = problem(excited(800, 1200))
    sd = np.sqrt(np.diag(check(whole).verdict.covariance))
    assert np.all(ranked.all_sd >= 0.999 * sd)
    assert all(np.all(w.sd >= 0.999 * sd) for w in ranked.windows)
    # A window of the whole record gives the result of `check`.
    [window] = windows(whole, 40.0).windows
    np.testing.assert_allclose(window.sd, sd, rtol=1e-3)
    assert ranked.guessed == ()


@pytest.mark.parametrize(
    ("length", "named"), [(0.18, "200"), (100.0, "longest flight"), (0.1, "9 for 3 free")]
)
def test_lengths_that_cannot_be_compared_are_refused(length, named):
    with pytest.raises(ValueError, match=named):
        windows(problem(excited(800, 1200)), length)


def test_damaged_windows_are_left_out_with_the_reason(ranked):
    f = excited(800, 1200)
    y = f.outputs["phi"].copy()
    y[900:950] = np.nan
    damaged = windows(problem(replace(f, outputs={"phi": y})), 4.0)
    for w in damaged.windows:
        gap = max(min(w.last, 950) - max(w.first, 900), 0) * DT > 0.3
        assert bool(w.excluded) == gap
    # A sensor at a fifth of the rate has no gaps.
    y = np.full(2000, np.nan)
    y[::5] = f.outputs["phi"][::5]
    sparse = replace(f, outputs={"phi": f.outputs["phi"], "p": f.outputs["phi"]})
    assert why_excluded(replace(sparse, outputs={"phi": y}, sd={}), 100, 300) == ""


CONFIG = """
model: roll-on-stand
vehicle: {vehicle}
flights:
  - log: bench.csv
    window: auto
    signals:
      time: {{signal: t}}
      inputs: {{x_roll: {{signal: stick, unit: m}}}}
      outputs: {{roll: {{signal: roll, unit: rad, sd: 0.002}}}}
fit:
  free:
    Ixx: {{start: 0.03}}
    If: {{start: 2.0e-4}}
"""


@pytest.mark.slow
def test_a_configuration_takes_the_windows(tmp_path, vehicles_folder):
    rng = np.random.default_rng(0)
    u = np.zeros(1500)
    u[500:1000] = 1.5e-5 * steps(rng, 500)
    t = np.arange(1500) * DT
    rows = np.c_[t, u, 0.002 * rng.standard_normal(1500)]
    np.savetxt(tmp_path / "bench.csv", rows, delimiter=",", header="t,stick,roll", comments="")
    path = tmp_path / "bench.yaml"
    path.write_text(CONFIG.format(vehicle=vehicles_folder / "bench-30.yaml"))
    flights = configured(load(path)).flights
    assert len(flights) >= 1
    for f in flights:
        assert not f.choose_windows
        assert f.t0 > 7.0
        assert f.source.notes[-1].code == "windows.chosen"
    assert main(["windows", str(tmp_path / "bench.csv"), str(path), "--length", "5"]) == 0
    assert main(["windows", str(path), "--length", "90"]) == 2
    with pytest.raises(InputError, match="hold_out"):
        configured(load(path, ["flights.0.hold_out=true"]))
    assert main(["check", str(path), "--set", "flights.0.window=best"]) == 2
