"""What `check` expects of gusts that nobody stated: their likeliest size, from any bank on."""

import numpy as np
import pytest
import scipy.linalg

from heli_jax.config import load
from heli_jax.config.problems import problem
from heli_jax.identification.estimation.likely_gusts import likely_gusts
from heli_jax.identification.fit import first_guess
from heli_jax.identification.unknowns.layout import Solution, unpack
from heli_jax.identification.validation.expected_accuracy import guessed_gusts

DT, N, GUST = 0.02, 800, 0.8
CONFIG = """
model: {{linear: roll-flybarless}}
flights:
  - log: {log}
    signals:
      time: {{signal: t}}
      inputs: {{lat: {{signal: lat, hold: zero-order}}}}
      outputs:
        phi: {{signal: phi, unit: rad, sd: 0.003}}
        p: {{signal: p, unit: rad/s, sd: 0.01}}
fit: {{method: filter-error, free: {{Lb: {{start: 140}}, Blat: {{start: 0.14}}}}}}
disturbance: {{on: [roll]}}
rls: null
"""


def flown(bank):
    """A roll in gusts of 0.8 rad/s^2 that begins in a bank [rad]."""
    rng = np.random.default_rng(3)
    A = np.array([[0, 1, 0, 0], [0, 0, 166.1, 1], [0, -1, -1 / 0.04631, 0], [0, 0, 0, -1 / 0.3]])
    B = np.array([[0], [0], [0.1398 / 0.04631], [0]])
    step = scipy.linalg.expm(DT * np.block([[A, B], [np.zeros((1, 5))]]))
    stick = 0.1 * np.sign(np.sin(np.arange(N) * DT * 4))
    x, rows, kept = np.array([bank, 0, 0, 0]), [], np.exp(-DT / 0.3)
    for k in range(N):
        rows.append((k * DT, stick[k], *(x[:2] + (0.003, 0.01) * rng.normal(size=2))))
        x = step[:4, :4] @ x + step[:4, 4] * stick[k]
        x[3] += GUST * np.sqrt(1 - kept**2) * rng.normal()
    return rows


@pytest.mark.slow
def test_a_bank_at_the_beginning_is_no_gust(tmp_path):
    sizes = []
    for bank in (0.0, -0.6):
        log, path = tmp_path / f"bank{bank}.csv", tmp_path / "config.yaml"
        np.savetxt(log, flown(bank), "%.8g", ",", header="t,lat,phi,p", comments="")
        path.write_text(CONFIG.format(log=log.name))
        asked = problem(load(path))
        guess = first_guess(asked)
        at = Solution(*guess[:4])
        z, e = likely_gusts(at, guess.e)
        # The sizes alone: all else stays where the problem begins.
        moved = {guess.layout.disturbance_at(n) for n in guess.layout.disturbance}
        assert set(np.flatnonzero(np.asarray(z) != np.asarray(guess.z))) <= moved
        np.testing.assert_array_equal(e.z, z)
        found = at._replace(z=z)
        sizes.append(float(unpack(found.layout, found.data, z).noise["sigma_w"]))
        [said] = guessed_gusts(asked, found)
        assert (said.code, said.subjects) == ("noise.gusts-guessed", ("sigma_w",))
    straight, banked = sizes
    assert banked == pytest.approx(straight, rel=0.4)
    assert banked > 0.5 * GUST
