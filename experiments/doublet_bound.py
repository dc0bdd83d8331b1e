"""Error of doublets that the Cramér-Rao bound allows for the R-50 in closed loop.

    .venv/bin/python experiments/doublet_bound.py [RECORDS] [RUNS]

Records, unknowns and doublets are those of experiments/closed_loop_frequency.py. Parameters are
drawn about the truth with three covariances. One is the Cramér-Rao bound (a Kalman filter with
known gusts and noise, at the truth). The others are those of fits with instruments and of direct
fits. Each draw gives Theil's coefficient (TIC) of the worse of both doublets, to first order. There
are RECORDS (10) sets of four flights. The largest of RUNS (40) draws compares with the largest of
as many fits.
"""

import functools

import closed_loop_frequency as study
import jax
import jax.numpy as jnp
import numpy as np
from r50_record import NOISE, truth, turbulent

from heli_jax import Flight, Nuisance, Problem, fit, naming, simulate
from heli_jax.dynamics.onboard.delays import with_delays
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.problem import Free
from heli_jax.identification.unknowns.layout import layout_of

jax.config.update("jax_enable_x64", True)
DRAWS = 4000
OWN_NOISE = ("sigma_w", "tau_w")


def covariance(e: Evaluation, count: int) -> np.ndarray:
    """Return the covariance of the first `count` unknowns, in their own units."""
    J = np.asarray(e.J, np.float64)
    R = np.linalg.qr(J, mode="r")
    root = np.linalg.inv(R)[:count] * np.asarray(e.slopes)[:count, None]
    return root @ root.T


def bound(seed: int) -> np.ndarray:
    """Return the bound for known gusts and noise: the Kalman filter's innovations at the truth."""
    model = with_delays(turbulent(), inputs=["lat", "lon"])
    values = {n: float(v) for n, v in naming.asdict(truth()).items()} | study.DELAYS
    flights = [
        Flight(dt=f.dt, inputs=f.inputs, outputs=f.outputs, sd={n: NOISE[n] for n in f.outputs})
        for f in study.problem(seed, "frequency-error").flights
    ]
    problem = Problem(
        model,
        model.Params(**{n: np.float64(v) for n, v in values.items()}),
        flights,
        {n: Free(v) for n, v in study.truths().items()},
        Nuisance(initial_state=False, bias=False, input_offset=False),
        method="filter-error",
        fixed_noise=OWN_NOISE,
    )
    layout = layout_of(problem, problem.training)
    data = data_of(problem, problem.training, layout)
    noise = first_noise(problem, problem.training)
    e = evaluate(layout, data, noise, start_vector(layout, data, problem))
    return covariance(e, len(study.truths()))


def stated(seed: int, method: str) -> np.ndarray:
    """Return the covariance that a fit states."""
    found = fit(study.problem(seed, **study.METHODS[method]), starts=1)
    e = evaluate(*found.reached)
    return covariance(e, len(study.truths()))


@functools.cache
def doublets() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return by stick the outputs (k,) at the truth over their noise, and derivatives (k, q)."""
    model, vehicle = study.models()[0], naming.asdict(study.linear_vehicle())
    names, N, made = list(study.truths()), round(4.0 / study.DT), []
    for stick in ("lat", "lon"):
        inputs = study.doublet(model, stick, N)

        def outputs(values: jax.Array, inputs=inputs) -> jax.Array:
            params = model.Params(**{**vehicle, **dict(zip(names, values, strict=True))})
            run = simulate(model, params, inputs, dt=study.DT).outputs
            return jnp.concatenate([getattr(run, n) / NOISE[n] for n in study.OUTPUTS])

        at = jnp.array([float(v) for v in study.truths().values()])
        made.append((np.asarray(outputs(at)), np.asarray(jax.jacfwd(outputs)(at))))
    return made


def tics(covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the TIC of draws (DRAWS,)."""
    errors = rng.multivariate_normal(np.zeros(len(covariance)), covariance, DRAWS)
    each = []
    for y, J in doublets():
        off = errors @ J.T
        rms = [np.sqrt(np.mean(v**2, axis=-1)) for v in (off, y, y + off)]
        each.append(rms[0] / (rms[1] + rms[2]))
    return np.maximum(*each)


def main(records: int, runs: int) -> None:
    print(f"| covariance | speed: sd | TIC: median | above 0.05 | largest of {runs}: median |")
    print("|---" * 5 + "|")
    speed = [list(study.truths()).index(n) for n in study.SPEED]
    sizes = np.abs([study.truths()[n] for n in study.SPEED])
    cases = {
        "Cramér-Rao bound": bound,
        "stated by instrument": lambda seed: stated(seed, "by instrument"),
        "stated directly": lambda seed: stated(seed, "direct"),
    }
    for name, of in cases.items():
        rng, covariances = np.random.default_rng(0), [of(seed) for seed in range(1, records + 1)]
        drawn = np.concatenate([tics(c, rng) for c in covariances])
        sd = np.median([np.median(np.sqrt(np.diag(c))[speed] / sizes) for c in covariances])
        largest = np.median(rng.choice(drawn, (2000, runs)).max(axis=1))
        print(
            f"| {name} | {100 * sd:.2g} % | {np.median(drawn):.3f} | "
            f"{100 * np.mean(drawn > 0.05):.2g} % | {largest:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "three minutes",
        Size("records", 10, 1, "of four flights each"),
        Size("runs", 40, 40, "of which the largest is shown"),
    )
    main(options.records, options.runs)
