"""What is said of the excited band where samples are missing, inputs are feeble, records short."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from heli_jax.identification.diagnostics.excitation import excited_bands
from heli_jax.identification.diagnostics.loop import feedback_tested
from heli_jax.identification.diagnostics.timing import of_rates
from heli_jax.identification.fit import context_of
from heli_jax.identification.validation.excited_band import excitation_of, seen_parts
from tests.identification.test_enough import DT, TRUTH, flight, found_of, problem, response


def swept(n=4000, noise=0.02):
    """A stick of noise below 2 Hz, and the response."""
    rng = np.random.default_rng(0)
    sos = scipy.signal.butter(4, 2.0, fs=1 / DT, output="sos")
    u = scipy.signal.sosfilt(sos, rng.standard_normal(n))
    phi, _ = response(u, np.zeros(n))
    y = phi + noise * np.std(phi) * rng.standard_normal(n)
    return replace(flight(n=n), inputs={"u": u, "v": np.zeros(n)}, outputs={"phi": y})


def without(f, *holes):
    y = f.outputs["phi"].copy()
    for hole in holes:
        y[hole] = np.nan
    return replace(f, outputs={"phi": y})


def severities(f):
    return [x.severity for x in found_of(excited_bands, f)]


def test_few_missing_samples_leave_the_band_as_it_is():
    f = swept()
    for holes in ((), (slice(0, 17),), (slice(100, 103), slice(2000, 2005), slice(3000, 3001))):
        assert severities(without(f, *holes)) == ["ok"]
    # A long hole cuts the record in two, and each part has whole segments.
    parts = seen_parts([without(f, slice(2000, 2100))]).parts
    assert [p.n_samples for p in parts] == [2000, 1900]
    assert severities(without(f, slice(2000, 2100))) == ["ok"]


def test_no_coherence_is_no_tick():
    f = swept()
    sparse = np.full(4000, np.nan)
    sparse[::5] = f.outputs["phi"][::5]
    for record in (replace(f, outputs={"phi": sparse}), flight(n=150)):
        assert severities(record) == ["note"]
    # Beside an output that is seen.
    assert severities(replace(f, outputs={"phi": sparse, "p": f.outputs["phi"]})) == ["ok"]


def test_a_line_of_vibration_is_no_band():
    rng, n = np.random.default_rng(0), 1000
    t = np.arange(n) * DT
    # Both hear one line, and have nothing else in common.
    line = 5.0 * np.sin(2 * np.pi * 11.0 * t)
    u, y = (line + rng.standard_normal(n) for _ in range(2))
    f = replace(flight(n=n), inputs={"u": u, "v": np.zeros(n)}, outputs={"phi": y})
    assert severities(f) == ["note"]
    assert excitation_of([f]).share is not None


def test_feedback_that_was_not_tested_is_said():
    short = problem(replace(swept(150), sd={"phi": 0.01}))
    [found] = feedback_tested(context_of(short))
    assert (found.code, found.severity) == ("loop.not-tested", "note")
    jumps = problem(flight(0))
    [found] = feedback_tested(context_of(jumps))
    assert (found.code, found.severity) == ("loop.not-tested", "note")


def test_modes_that_do_not_swing_ask_for_a_rate_too():
    # 400 = 10 * 40: two decays, the faster of 40 rad/s = 6.4 Hz.
    model = problem(flight(0))
    vehicle = TRUTH._replace(k=400.0, d=50.0, b=220.0)
    free = {n: f._replace(start=getattr(vehicle, n)) for n, f in model.free.items()}
    for every, severity in ((1, "ok"), (3, "doubt"), (8, "refuse")):
        f = flight(0, 3000)
        slow = replace(
            f,
            dt=DT * every,
            inputs={n: u[::every] for n, u in f.inputs.items()},
            outputs={"phi": f.outputs["phi"][::every]},
            sd={"phi": 1e-6},
        )
        asked = replace(model, vehicle=vehicle, flights=(slow,), free=free)
        [found] = of_rates(asked, [{"phi": 1e-6}])
        assert found.severity == severity
        assert found.value == pytest.approx(2.0 * np.pi / 40.0 / (DT * every))
        # Guessed noise as large as the motion hides no mode; a stated one does.
        [guessed] = of_rates(replace(asked, flights=(replace(slow, sd={}),)), [{"phi": 1.0}])
        assert guessed.severity == severity
        assert not list(of_rates(asked, [{"phi": 1.0}]))


@pytest.mark.parametrize("every", [1, 2])
def test_a_machine_in_gusts_is_seen_to_follow_at_half_the_rate_too(every):
    # 60 s: at 50 Hz there were eight segments, whose coherence had to pass 0.8.
    rng, n = np.random.default_rng(5), 6000
    u = np.repeat(rng.choice([-0.2, 0.2], n // 20), 20)
    slow = scipy.signal.butter(1, 2.0, fs=100.0, output="sos")
    gust = scipy.signal.sosfilt(slow, rng.standard_normal(n))
    y = scipy.signal.sosfilt(slow, u)
    y += 0.76 * np.std(y) / np.std(gust) * gust
    signals = {"u": u[::every], "v": np.zeros(n)[::every]}
    record = replace(
        flight(n=n // every), dt=0.01 * every, inputs=signals, outputs={"phi": y[::every]}
    )
    assert severities(record) == ["ok"]
    assert excitation_of([record]).limit == 0.6


def test_flights_in_which_the_sticks_rest_say_nothing_of_whether_they_move_together():
    """Long ones at rest set the length of segments, which the one that moves them did not fill:
    their coherence was no number, and `nothing in the record tells what each does`."""
    rng = np.random.default_rng(0)
    sos = scipy.signal.butter(2, 1.5, fs=1 / DT, output="sos")

    def moved(n, size):
        u, v = size * scipy.signal.sosfilt(sos, rng.standard_normal((2, n)))
        y = response(u, v)[0] + 1e-3 * rng.standard_normal(n)
        return replace(flight(n=n), inputs={"u": u, "v": v}, outputs={"phi": y})

    short = moved(500, 1.0)
    for resting in (0, 8):
        found = excitation_of([short, *(moved(1500, 0.0) for _ in range(resting))])
        [together] = found.pairs
        assert together.coherence < found.pair_limit
