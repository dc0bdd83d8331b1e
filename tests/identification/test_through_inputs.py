"""Information from the disturbance's spectrum, separate from that of the inputs."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.identifiability.analysis import verdict_of
from heli_jax.identification.search import first_guess
from heli_jax.identification.uncertainty.estimates import through_inputs
from heli_jax.identification.unknowns.layout import Solution

TRUTH = {"Lb": 95.0, "tau": 0.06, "Blat": 0.11, "kappa": 3.0, "zeta": 0.4}
DT, SIGMA, TAU = 0.02, 0.25, 0.5
# p/lat has four coefficients: Lb Blat / tau, zeta + 1 / tau, kappa + zeta / tau + Lb, kappa / tau.
STAND = """
name: stand
states: {phi: rad, p: rad/s, b: rad}
inputs: {lat: "1"}
outputs: {phi: rad, p: rad/s}
parameters:
  Lb: {value: 95.0, unit: 1/s^2, source: assumed}
  tau: {value: 0.06, unit: s, source: assumed, positive: true}
  Blat: {value: 0.11, unit: rad, source: assumed}
  kappa: {value: 3.0, unit: 1/s^2, source: assumed}
  zeta: {value: 0.4, unit: 1/s, source: assumed}
A:
  phi: {p: 1}
  p: {b: Lb, phi: -kappa, p: -zeta}
  b: {p: -1, b: -1/tau}
B:
  b: {lat: Blat/tau}
"""


def problem(folder, seconds, free=tuple(TRUTH), memory=0.0, seed=0):
    """Return a stand in gusts, by matrix exponentials of ten steps per sample.

    The measurement noise has an autocorrelation at lag one.
    """
    (folder / "stand.yaml").write_text(STAND)
    stand = linear_model(folder / "stand.yaml")
    rng, n, fine = np.random.default_rng(seed), round(seconds / DT), 10
    lat = np.repeat(rng.choice([-0.25, 0.0, 0.25], n // 40 + 1), 40)[:n]
    Lb, tau, Blat, kappa, zeta = TRUTH.values()
    A = np.array([[0, 1, 0], [-kappa, -zeta, Lb], [0, -1, -1 / tau]])
    B = np.array([[0, 0], [0, 1], [Blat / tau, 0]])
    h = DT / fine
    E = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 5))]]) * h)
    push = SIGMA * np.sqrt(2 * h / TAU) * rng.standard_normal(n * fine)
    w = scipy.signal.lfilter([1.0], [1.0, h / TAU - 1.0], push)
    x, states = np.zeros(3), np.empty((n, 3))
    for k in range(n * fine):
        if k % fine == 0:
            states[k // fine] = x
        x = E[:3, :3] @ x + E[:3, 3:] @ [lat[k // fine], w[k]]
    noise = scipy.signal.lfilter(
        [np.sqrt(1 - memory**2)], [1.0, -memory], rng.standard_normal((2, n))
    )
    outputs = {"phi": states[:, 0] + 2e-3 * noise[0], "p": states[:, 1] + 1e-2 * noise[1]}
    return Problem(
        with_disturbance(stand.model, "roll"),
        with_noise(stand),
        [Flight(dt=DT, inputs={"lat": lat}, outputs=outputs)],
        {name: Free(TRUTH[name]) for name in free},
        method="filter-error",
    )


def with_noise(stand):
    Params = with_disturbance(stand.model, "roll").Params
    return Params(**stand.vehicle().params._asdict(), sigma_w=SIGMA, tau_w=TAU)


def verdicts(problem):
    """Return the information at the truth: of the innovations, and of the inputs."""
    guess = first_guess(problem)
    at = Solution(*guess[:4])
    e = evaluate(at.layout, at.data, at.noise, at.z)
    inputs = through_inputs(at, e)
    # Noise parameters need exact zeros, since scaling would enlarge rounding.
    assert not inputs.J[:, [at.layout.disturbance_at(n) for n in ("sigma_w", "tau_w")]].any()
    return verdict_of(problem, at.layout, e), verdict_of(problem, at.layout, inputs)


def test_no_input_tells_five_parameters_from_four_coefficients(tmp_path):
    everything, inputs = verdicts(problem(tmp_path, 60.0))
    assert not inputs.identifiable
    assert set(inputs.undetermined) == set(TRUTH)
    # The zero of the response to gusts alone determines tau.
    assert everything.singular_values[-1] > 10 * inputs.singular_values[-1]
    # The inputs determine the other four directions.
    np.testing.assert_allclose(everything.singular_values[:3], inputs.singular_values[:3], rtol=0.2)


@pytest.mark.slow
def test_the_colour_of_innovations_that_are_not_white_determines_nothing(tmp_path):
    found = fit(problem(tmp_path, 60.0, memory=0.5))
    assert not all(w.white for w in found.whiteness.values())
    assert found.status == "not-identifiable"
    assert all(one.lower95 is None for one in found.estimates.values())
    assert found.verdict.combinations == ()
