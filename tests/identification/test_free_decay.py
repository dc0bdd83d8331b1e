"""A vehicle that is released, or at rest under a constant input."""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from heli_jax import cli, load_config
from heli_jax.config import problem, read_flights
from heli_jax.errors import InputError
from heli_jax.identification.fit import check, fit

STIFFNESS, DAMPING, MOTOR, STEP = 1.65, 0.2, 0.08, 0.02
MODEL = """
name: bench
states: {theta: rad, q: rad/s}
inputs: {V: V}
outputs: {theta: rad}
parameters:
  k: {value: 1.0, unit: 1/s^2, positive: true}
  d: {value: 0.1, unit: 1/s, positive: true}
  b: {value: 0.08, unit: rad/s^2/V}
A: {theta: {q: 1}, q: {theta: -k, q: -d}}
B: {q: {V: b}}
"""
CONFIG = """
model: {linear: m.yaml}
flights:
  - log: log.csv
    gaps: GAPS
    signals:
      time: {signal: t}
      inputs: INPUTS
      outputs: {theta: {signal: theta, unit: rad}}
fit:
  nuisance: {input_offset: false}
  free: {k: {start: 1.0}, d: {start: 0.1}}
rls: null
"""
LOGGED = "{V: {signal: V, unit: V}}"


def motion(angle: float, voltage: float, n: int = 1400) -> np.ndarray:
    """Return the angle (n,) by the matrix exponential, with noise of 2 mrad."""
    M = np.zeros((3, 3))
    M[0, 1], M[1] = 1.0, (-STIFFNESS, -DAMPING, MOTOR)
    F, x, y = scipy.linalg.expm(M * STEP), np.array([angle, 0.0, voltage]), []
    for _ in range(n):
        y.append(x[0])
        x = F @ x
    return np.array(y) + 0.002 * np.random.default_rng(0).standard_normal(n)


def configured(folder: Path, rows: np.ndarray, inputs: str = LOGGED, gaps: str = "fail") -> Path:
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="t,V,theta", comments="")
    (folder / "m.yaml").write_text(MODEL)
    path = folder / "c.yaml"
    path.write_text(CONFIG.replace("INPUTS", inputs).replace("GAPS", gaps))
    return path


def rows(angle: float, voltage: float) -> np.ndarray:
    y = motion(angle, voltage)
    return np.stack([STEP * np.arange(y.size), np.full(y.size, voltage), y], axis=1)


@pytest.mark.parametrize(("angle", "voltage"), [(0.4, 0.0), (0.0, 10.0)])
def test_a_release_and_a_constant_input_determine_the_machine(
    tmp_path: Path, angle: float, voltage: float
) -> None:
    asked = problem(load_config(configured(tmp_path, rows(angle, voltage))))
    before = check(asked)
    assert before.verdict.undetermined == before.verdict.without_effect == ()
    assert not any(f.bad for f in before.findings)
    estimate = fit(asked)
    assert estimate.status == "converged"
    assert estimate.exit_code == 0
    for name, truth in (("k", STIFFNESS), ("d", DAMPING)):
        one = estimate.estimates[name]
        # By SciPy's least squares with a free initial state: 2.5e-4 and 1.9e-4, or 1.3e-4, 1.5e-4.
        assert 1e-4 < one.sd < 3e-4
        assert abs(one.value - truth) < 3.0 * one.sd


def test_no_input_at_all_may_be_stated(tmp_path: Path) -> None:
    (flight,) = read_flights(load_config(configured(tmp_path, rows(0.4, 0.0), "{}")))
    np.testing.assert_array_equal(flight.inputs["V"], np.zeros(1400))
    assert cli.main(["frf", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "f")]) == 2


def test_noise_alone_is_no_free_decay(tmp_path: Path) -> None:
    still = problem(load_config(configured(tmp_path, rows(0.0, 0.0))))
    assert not check(still).verdict.identifiable
    assert fit(still).exit_code != 0


def test_releases_one_after_another_become_flights(tmp_path: Path) -> None:
    one, other = rows(0.4, 0.0), rows(-0.3, 0.0)
    other[:, 0] += 60.0
    both = read_flights(
        load_config(configured(tmp_path, np.concatenate([one, other]), gaps="split"))
    )
    assert [f.n_samples for f in both] == [1400, 1400]
    # Before a flight, on the ground, the stick has no effect and gives no information.
    other[700:, 1] = 1.0
    both = read_flights(
        load_config(configured(tmp_path, np.concatenate([one, other]), gaps="split"))
    )
    assert [f.t0 for f in both] == [60.0]


def test_an_output_that_never_moves_is_refused(tmp_path: Path) -> None:
    still = rows(0.4, 0.0)
    still[:, 2] = 0.4
    with pytest.raises(InputError):
        problem(load_config(configured(tmp_path, still)))
