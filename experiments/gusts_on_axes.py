"""Gusts on four axes: coverage of the intervals, and detection of a disturbance left out.

    .venv/bin/python experiments/gusts_on_axes.py [RUNS] [SAMPLES] [--out FOLDER]

A hovering vehicle's rates and heave (p, q, r, w) have coupled damping. Each is disturbed by an
Ornstein-Uhlenbeck process with its own size and time constant, simulated with SciPy alone. Every
record is fitted with all four disturbances, and with each left out in turn. The missing one is
found if AIC prefers all four. FOLDER (runs/gusts-on-axes) stores a line for each run, so that an
interrupted study can continue.
"""

import json
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.select import alternatives
from heli_jax.simulation.inputs import random_steps

DT, NOISE = 0.02, {"p": 0.01, "q": 0.01, "r": 0.01, "w": 0.03}
ON = ("p", "q", "r", "w")
TRUTH = {"Lp": -6.0, "Lq": 1.5, "Mq": -3.0, "Mp": -0.8, "Nr": -2.0, "Zw": -0.7}
SIZES = {"p": 3.0, "q": 1.5, "r": 1.0, "w": 1.0}
TIMES = {"p": 0.4, "q": 0.8, "r": 0.5, "w": 1.5}
EFFECT = np.diag([8.0, 5.0, 6.0, 4.0])


class Derivatives(NamedTuple):
    Lp: Annotated[Any, "1/s"]
    Lq: Annotated[Any, "1/s"]
    Mq: Annotated[Any, "1/s"]
    Mp: Annotated[Any, "1/s"]
    Nr: Annotated[Any, "1/s"]
    Zw: Annotated[Any, "1/s"]


class Motion(NamedTuple):
    p: Annotated[Any, "rad/s"]
    q: Annotated[Any, "rad/s"]
    r: Annotated[Any, "rad/s"]
    w: Annotated[Any, "m/s"]


class Sticks(NamedTuple):
    lat: Annotated[Any, "1"]
    lon: Annotated[Any, "1"]
    ped: Annotated[Any, "1"]
    col: Annotated[Any, "1"]


def _rates(d: Derivatives, s: Motion, u: Sticks) -> Motion:
    return Motion(
        d.Lp * s.p + d.Lq * s.q + EFFECT[0, 0] * u.lat,
        d.Mp * s.p + d.Mq * s.q + EFFECT[1, 1] * u.lon,
        d.Nr * s.r + EFFECT[2, 2] * u.ped,
        d.Zw * s.w + EFFECT[3, 3] * u.col,
    )


MODEL = Model(
    "rates-and-heave", _rates, lambda d, s, u: s, Derivatives, Motion, Sticks, Motion, linear=True
)


def record(seed: int, n: int) -> Flight:
    """Return a flight in gusts, exact from sample to sample (Van Loan, 1978)."""
    rng = np.random.default_rng(seed)
    t = TRUTH
    machine = np.array(
        [[t["Lp"], t["Lq"], 0, 0], [t["Mp"], t["Mq"], 0, 0], [0, 0, t["Nr"], 0], [0, 0, 0, t["Zw"]]]
    )
    tau, sigma = np.array([TIMES[k] for k in ON]), np.array([SIZES[k] for k in ON])
    A = np.block([[machine, np.eye(4)], [np.zeros((4, 4)), -np.diag(1.0 / tau)]])
    B = np.vstack([EFFECT, np.zeros((4, 4))])
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((4, 12))]]) * DT)
    Phi, Gamma = held[:8, :8], held[:8, 8:]
    drive = np.diag(np.concatenate([np.zeros(4), 2.0 * sigma**2 / tau]))
    loan = scipy.linalg.expm(np.block([[-A, drive], [np.zeros((8, 8)), A.T]]) * DT)
    Q = loan[8:, 8:].T @ loan[:8, 8:]
    # Q is almost singular: within one sample a gust's effect on a rate almost equals the gust
    # itself.
    values, vectors = np.linalg.eigh(0.5 * (Q + Q.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    u = np.stack([0.2 * random_steps(n, DT, rng, (0.3, 2.0)) for _ in ON])
    x, xs = np.concatenate([np.zeros(4), sigma * rng.standard_normal(4)]), np.empty((n, 4))
    for k in range(n):
        xs[k] = x[:4]
        x = Phi @ x + Gamma @ u[:, k] + root @ rng.standard_normal(8)
    outputs = {name: xs[:, i] + NOISE[name] * rng.standard_normal(n) for i, name in enumerate(ON)}
    return Flight(dt=DT, inputs=dict(zip(Sticks._fields, u, strict=True)), outputs=outputs)


def problem(flight: Flight) -> Problem:
    """Return the problem with all four disturbances, and every derivative off by a factor."""
    free = {name: Free(0.6 * value) for name, value in TRUTH.items()}
    model = with_disturbance(MODEL, ON)
    start = model.Params(**{n: jnp.asarray(v) for n, v in TRUTH.items()})
    off = Nuisance(initial_state=False, bias=False)
    return Problem(model, start, [flight], free, off, method="filter-error")


def one_run(seed: int, n: int) -> dict[str, Any]:
    """Return which intervals cover, and the AIC and whiteness against each disturbance left out."""
    flight = record(seed, n)
    sets = alternatives(problem(flight), MODEL, ON).problems
    whole = fit(sets[f"all: {', '.join(ON)}"])
    truth = {f"sigma_w_{k}": v for k, v in SIZES.items()}
    truth |= {f"tau_w_{k}": v for k, v in TIMES.items()} | TRUTH
    covers = {}
    for name, estimate in {**whole.nuisance, **whole.estimates}.items():
        if name in truth and estimate.lower95 is not None and estimate.upper95 is not None:
            covers[name] = bool(estimate.lower95 < truth[name] < estimate.upper95)
    left_out = {}
    for name, candidate in sets.items():
        if name.startswith("without"):
            lacking = fit(candidate)
            left_out[name.split()[1].rstrip(":")] = {
                "status": lacking.status,
                "aic_above": lacking.aic - whole.aic,
                "white": lacking.white,
            }
    return {
        "seed": seed, "status": whole.status, "steps": whole.steps, "white": whole.white,
        "covers": covers, "left_out": left_out,
    }  # fmt: skip


def table(runs: list[dict[str, Any]], n: int) -> str:
    done = [r for r in runs if r["status"] == "converged"]
    lines = [f"{len(runs)} runs of {n} samples, {len(done)} converged with all four.", ""]
    each = {k: [r["covers"][k] for r in done if k in r["covers"]] for k in done[0]["covers"]}
    physical = [c for k in TRUTH for c in each.get(k, [])]
    noise = [c for k, v in each.items() if k not in TRUTH for c in v]
    lines += ["| 95 % intervals of | cover | of |", "|---|---|---|"]
    lines += [
        f"| {words} | {100 * np.mean(c):.1f} % | {len(c)} |"
        for words, c in (("derivatives", physical), ("sigma_w and tau_w", noise))
    ]
    lines += [
        "",
        "| left out | found by AIC | by at least | innovations not white |",
        "|" + "---|" * 4,
    ]
    for name in ON:
        above = np.array([r["left_out"][name]["aic_above"] for r in done])
        white = np.mean([not r["left_out"][name]["white"] for r in done])
        lines.append(
            f"| {name} | {int((above > 0).sum())} of {len(done)} | {above.min():.1f} | "
            f"{100 * white:.0f} % |"
        )
    right = np.mean([r["white"] for r in done])
    return "\n".join([*lines, "", f"White with all four: {100 * right:.0f} %."]) + "\n"


def main(count: int, n: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"runs-{n}.jsonl"
    kept = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    runs = {r["seed"]: r for r in (json.loads(line) for line in kept)}
    for seed in range(count):
        if seed in runs:
            continue
        runs[seed] = one_run(seed, n)
        with log.open("a", encoding="utf-8") as f:
            f.write(json.dumps(runs[seed]) + "\n")
        print(f"{seed + 1} of {count} runs", file=sys.stderr, flush=True)
    text = table([runs[s] for s in range(count)], n)
    (folder / "table.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    from script import Size, asked

    jax.config.update("jax_enable_x64", True)
    options = asked(
        __doc__,
        "hours",
        Size("runs", 100, 1, "records"),
        Size("samples", 3000, 1500, "of each"),
        out="runs/gusts-on-axes",
    )
    main(options.runs, options.samples, options.out)
