"""Bootstrap of fits in frequency: the draws, and the scatter of estimates."""

import jax
import numpy as np
import pytest

from heli_jax import stages
from heli_jax.identification.estimation.frequency_lines import errors_of_lines, in_time_of, lines_of
from heli_jax.identification.uncertainty.bootstrap import _spectrum_records, bootstrap


@pytest.mark.parametrize("N", [7, 100, 101])
def test_lines_go_back_to_the_samples_they_came_of(N):
    v = np.random.default_rng(N).standard_normal((N, 2))
    lines = lines_of(v)
    np.testing.assert_allclose(lines_of(in_time_of(lines, N)), lines, atol=1e-12)


def test_a_record_that_is_drawn_differs_in_its_noise_alone(fitted_by_lines):
    at = fitted_by_lines.reached
    [errors] = jax.device_get(errors_of_lines(at.layout, at.data, at.noise, at.z).errors)
    drawn, powers = _spectrum_records(at, np.random.default_rng(1)), []
    for _ in range(40):
        other = next(drawn)
        [y], [before] = (list(d.flights[0].outputs.values()) for d in (other, at.data))
        y, before = np.asarray(y), np.asarray(before)
        # The fixed part is measured less residual; the drawn part has the residual's size at each
        # line.
        new = lines_of((y - before)[:, None]) + errors
        powers.append(np.abs(new[:, 0]) ** 2)
        assert other.flights[0].inputs is at.data.flights[0].inputs
    for band in (slice(0, 60), slice(60, 400), slice(400, None)):
        ratio = np.mean(powers, axis=0)[band].sum() / np.sum(np.abs(errors[band]) ** 2)
        assert ratio == pytest.approx(1.0, rel=0.2)


def test_estimates_scatter_as_their_intervals_say(fitted_by_lines):
    booted = bootstrap(fitted_by_lines, 40, seed=2)
    assert booted.failures == 0
    for name, one in fitted_by_lines.estimates.items():
        values = booted.values[name]
        assert np.std(values, ddof=1) == pytest.approx(one.sd, rel=0.45)
        assert abs(np.mean(values) - one.value) < 0.6 * one.sd


def test_the_stage_counts_records_and_no_steps_of_their_searches(fitted_by_lines):
    class Heard:
        def __init__(self):
            self.ended = []

        def begin(self, stage):
            pass

        def end(self, stage):
            self.ended.append((stage.words, stage.done))

    heard = Heard()
    with stages.observed_by(heard), stages.stage("bootstrap", total=3):
        bootstrap(fitted_by_lines, 3, seed=2)
    assert ("bootstrap", 3) in heard.ended
