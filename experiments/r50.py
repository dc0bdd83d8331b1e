"""Filter error on a whole helicopter: the R-50 in closed loop, in turbulence on six axes.

    .venv/bin/python experiments/r50.py [FITS] [RECORDS] [SECONDS] [--out FOLDER]

FITS (3) sets of RECORDS (1) flights of SECONDS (60) each are fitted from starts off by a factor of
0.6 to 1.6; the full size is `40 4`. 33 derivatives, six intensities and correlation times of the
turbulence and the noise of eight outputs are unknown. FOLDER (runs/r50) stores a line for each fit,
so that an interrupted study can continue; table.md covers all fits. Each set gives its score at the
truth (chi-squared with one degree per unknown). The first set also gives the identifiability
analysis with Kr free.
"""

import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from r50_record import FIXED, NOISE, problem, record

from heli_jax import Flight, Problem
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import optimise
from heli_jax.identification.identifiability.analysis import verdict_of
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, layout_of

jax.config.update("jax_enable_x64", True)
STEPS = 30
"""Most steps of a converged search; the target is 15."""
Z95 = 1.959963984540054
ROTOR = ("tau_f", "Ab", "Ac", "Alat", "Alon", "Ba", "Bd", "Blat", "Blon", "Lb", "Ma")
BAR = ("tau_s", "Clon", "Dlat")


class Prepared(NamedTuple):
    """A problem with its data, and the initial noise."""

    problem: Problem
    layout: Layout
    data: Data
    noise: Noise
    z: jax.Array
    """Unknowns at the problem's starts."""


def prepared(flights: list[Flight], **more: Any) -> Prepared:
    of, flights_ = problem(flights, **more), tuple(flights)
    layout, data = layout_of(of, flights_), data_of(of, flights_)
    # The factor of each noise is an unknown that starts here.
    sd = tuple({n: np.float64(NOISE[n]) for n in sorted(f.outputs)} for f in flights)
    z = jnp.asarray(start_vector(layout, data, of))
    return Prepared(of, layout, data, Noise(sd, np.zeros(())), z)


def at(of: Prepared, z: jax.Array) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the free parameters, their sds, and the score's chi-squared per degree."""
    e = evaluate(of.layout, of.data, of.noise, z)
    r, J, free = np.asarray(e.r), np.asarray(e.J), len(of.layout.free)
    sd = deviations(J)[:free] * np.abs(np.asarray(e.slopes)[:free])
    step = np.linalg.lstsq(J, r, rcond=None)[0]
    return np.asarray(e.named)[:free], sd, float(step @ (J.T @ r) / J.shape[1])


def one_fit(seed: int, records: int, seconds: float) -> dict[str, Any]:
    """Return errors in units of the Cramér-Rao bound and of the stated sd."""
    flights = [record(100 * seed + i, seconds) for i in range(records)]
    true = prepared(flights)
    truth, bound, score = at(true, true.z)
    rng = np.random.default_rng(seed)
    names = (*true.layout.free, "sigma_w", "tau_w")
    spread = np.exp(rng.uniform(np.log(0.6), np.log(1.6), len(names)))
    factors = dict(zip(names, spread, strict=True))
    begin, of = time.perf_counter(), prepared(flights, factors=factors)
    optimum = optimise(of.layout, of.data, of.noise, of.z, STEPS)
    took = time.perf_counter() - begin
    estimate, sd, _ = at(of, optimum.z)
    best = at_cost(true, optimise(true.layout, true.data, true.noise, true.z, STEPS).z)
    return {
        "seed": seed,
        "converged": bool(optimum.converged),
        "same_optimum": bool(abs(at_cost(of, optimum.z) - best) < 0.5),
        "steps": int(optimum.steps),
        "seconds": took,
        "score": score,
        "error": dict(zip(true.layout.free, ((estimate - truth) / bound).tolist(), strict=True)),
        "z": dict(zip(true.layout.free, ((estimate - truth) / sd).tolist(), strict=True)),
    }


def at_cost(of: Prepared, z: jax.Array) -> float:
    """Return the log-likelihood."""
    e = evaluate(of.layout, of.data, of.noise, z)
    return of.layout.objective.log_likelihood(of.layout, of.data, of.noise, e)


def table(fits: list[dict[str, Any]]) -> str:
    names = [n for n in fits[0]["error"] if not n.startswith(("sigma_", "tau_"))]
    names += ["tau_f", "tau_s"]
    rows = ["| of | RMSE over Cramér-Rao, median | covered by 95 % |", "|---|---|---|"]
    for label, chosen in (("rotor", ROTOR), ("bar", BAR), ("all derivatives", tuple(names))):
        error = np.array([[f["error"][n] for n in chosen] for f in fits])
        z = np.array([[f["z"][n] for n in chosen] for f in fits])
        rmse = np.median(np.sqrt(np.mean(error**2, axis=0)))
        rows.append(f"| {label} | {rmse:.2f} | {100 * np.mean(np.abs(z) < Z95):.0f} % |")
    ended = [f for f in fits if f["converged"] and f["same_optimum"]]
    steps = [f["steps"] for f in ended] or [0]
    rows.append(
        f"\n{len(fits)} fits; {len(ended)} reach the optimum that a search from the truth reaches, "
        f"in {min(steps)} to {max(steps)} steps; score at the truth "
        f"{np.mean([f['score'] for f in fits]):.3f} per degree of freedom."
    )
    return "\n".join(rows)


def identifiability(records: int, seconds: float) -> str:
    """Return the identifiability analysis at the truth with Kr free."""
    flights = [record(100 + i, seconds) for i in range(records)]
    of = prepared(flights, fixed=tuple(n for n in FIXED if n != "Kr"))
    verdict = verdict_of(of.problem, of.layout, evaluate(of.layout, of.data, of.noise, of.z))
    return verdict.text


def main(fits: int, records: int, seconds: float, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    lines = out / f"fits-{records}x{seconds:g}.jsonl"
    done = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    known = {f["seed"] for f in done}
    for seed in (s for s in range(1, fits + 1) if s not in known):
        done.append(one_fit(seed, records, seconds))
        with lines.open("a") as file:
            file.write(json.dumps(done[-1]) + "\n")
        print({k: v for k, v in done[-1].items() if k not in ("error", "z")}, flush=True)
    text = table(done) + "\n\n" + identifiability(records, seconds) + "\n"
    (out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "ten minutes",
        Size("fits", 3, 1, "sets of records"),
        Size("records", 1, 1, "flights of each set"),
        Size("seconds", 60.0, 60.0, "of each flight"),
        out="runs/r50",
    )
    main(options.fits, options.records, options.seconds, options.out)
