"""Effect of feedback on estimates: bias over loop gain and gusts.

    .venv/bin/python experiments/closed_loop.py [RUNS] [delay]

A pilot flies a vehicle in roll, p' = Lp p + Lda da + gusts. He holds the bank angle with a delay of
0.1 s and adds test steps. Each record is fitted by output error, and by filter error with a
disturbance on roll. The table has the mean relative error of Lp and Lda over the runs, and the
number of runs in which the loop was detected. With `delay` the aileron acts 60 ms after the stick.
The delay is then free too, with the five starts of a free delay. The frequency domain is in
closed_loop_frequency.py.
"""

from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import scipy.linalg

from heli_jax import Flight, Free, Model, Problem, fit
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import Axis
from heli_jax.dynamics.onboard.delays import with_delays
from heli_jax.identification.validation.follows_response import feedback
from heli_jax.naming import Scalar, asdict
from heli_jax.simulation.inputs import random_steps

jax.config.update("jax_enable_x64", True)

N, DT, LATE, STEP = 1500, 0.02, 5, 0.05
SD = {"p": 0.02, "phi": 0.01}
TAU = 0.5
GAINS, GUSTS = (0.0, 0.1, 0.3, 0.6), (0.0, 0.5, 2.0)


class Params(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "roll damping"] = -4.0
    Lda: Annotated[Scalar, "1/s^2", "aileron's effect"] = 25.0


class State(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]
    phi: Annotated[Scalar, "rad", "bank angle"]


class Inputs(NamedTuple):
    da: Annotated[Scalar, "rad", "aileron"]


def vector_field(params: Params, x: State, u: Inputs) -> State:
    return State(p=params.Lp * x.p + params.Lda * u.da, phi=x.p)


def output(params: Params, x: State, u: Inputs) -> State:
    return x


ROLL = Model(
    "closed-loop-roll",
    vector_field,
    output,
    Params,
    State,
    Inputs,
    State,
    linear=True,
    axes=(Axis("roll", rate="p", angle="phi", stick="da"),),
)
DISTURBED = with_disturbance(ROLL, "roll")
TRUTH = {"Lp": -4.0, "Lda": 25.0}
DELAY = "delay_da"
ACTS = 3
"""Delay of the aileron with `delay` [samples]."""
DELAYED = with_delays(ROLL, inputs=["da"])
DELAYED_DISTURBED = with_disturbance(DELAYED, "roll")


def record(gain: float, gust: float, seed: int, acts: int = 0) -> Flight:
    """Return a record with the pilot's gain [rad/rad] and the gusts' standard deviation [rad/s^2].

    The aileron acts `acts` samples after the stick.
    """
    rng = np.random.default_rng(seed)
    # States, held stick, and gust, constant over one sample.
    A = np.zeros((4, 4))
    A[0] = [TRUTH["Lp"], 0.0, TRUTH["Lda"], 1.0]
    A[1, 0] = 1.0
    over = scipy.linalg.expm(A * DT)[:2]
    steps = STEP * random_steps(N, DT, rng, (0.2, 1.5))
    keeps = float(np.exp(-DT / TAU))
    x, w, states, sticks = np.zeros(2), gust * rng.standard_normal(), [], []
    for k in range(N):
        states.append(x)
        seen = states[max(k - LATE, 0)]
        da = steps[k] - gain * (seen[1] + 0.2 * seen[0])
        sticks.append(da)
        x = over @ np.array([*x, sticks[max(k - acts, 0)], w])
        w = keeps * w + gust * np.sqrt(1.0 - keeps**2) * rng.standard_normal()
    motion = np.array(states)
    outputs = {n: motion[:, i] + SD[n] * rng.standard_normal(N) for i, n in enumerate(("p", "phi"))}
    return Flight(dt=DT, inputs={"da": np.array(sticks)}, outputs=outputs, sd=SD)


def estimates(flight: Flight, truth: dict[str, float]) -> dict[str, dict[str, float]]:
    """Return the relative errors of all parameters by method; NaN if not converged."""
    free = {"Lp": Free(-2.0), "Lda": Free(10.0)}
    bare, disturbed, values = ROLL, DISTURBED, asdict(Params())
    if DELAY in truth:
        bare, disturbed, values = DELAYED, DELAYED_DISTURBED, {**values, DELAY: 0.03}
        free[DELAY] = Free(0.03)
    problems: dict[str, Any] = {
        "output error": Problem(bare, bare.Params(**values), [flight], free),
        "filter error": Problem(
            disturbed, disturbed.Params(**values), [flight], free, method="filter-error"
        ),
    }
    errors = {}
    for method, problem in problems.items():
        result = fit(problem)
        fine = result.status == "converged"
        errors[method] = {
            n: result.estimates[n].value / true - 1.0 if fine else float("nan")
            for n, true in truth.items()
        }
    return errors


def row(gain: float, gust: float, runs: int, truth: dict[str, float]) -> str:
    acts = ACTS if DELAY in truth else 0
    flights = [record(gain, gust, seed, acts) for seed in range(runs)]
    closed = sum(any(f.present for f in feedback(flight)) for flight in flights)
    found = [estimates(flight, truth) for flight in flights]
    cells = []
    for method in ("output error", "filter error"):
        for name in truth:
            e = 100.0 * np.array([one[method][name] for one in found])
            fine = e[np.isfinite(e)]
            if not fine.size:
                cells.append("none")
                continue
            cells.append(f"{fine.mean():+.1f} ± {fine.std() / fine.size**0.5:.1f} %")
    return f"| {gain:g} | {gust:g} | {closed} of {runs} | " + " | ".join(cells) + " |"


def main(runs: int, *, delay: bool) -> None:
    truth = TRUTH | ({DELAY: ACTS * DT} if delay else {})
    names = [f"{method} {name}" for method in ("OE", "FE") for name in truth]
    print(f"{runs} records of {N * DT:g} s each; mean error and its standard error.\n")
    print("| gain | gusts [rad/s²] | loop detected | " + " | ".join(names) + " |")
    print("|" + "---|" * (3 + len(names)))
    for gust in GUSTS:
        for gain in GAINS:
            print(row(gain, gust, runs, truth), flush=True)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "ten minutes",
        Size("runs", 6, 1, "records of each gain and gust"),
        Size("delay", "", "", "the word delay: the aileron acts late"),
    )
    main(options.runs, delay=options.delay == "delay")
