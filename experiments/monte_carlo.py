"""Comparison of filter error, output error and RLS on many disturbed bench runs.

    .venv/bin/python experiments/monte_carlo.py [RUNS] [--out FOLDER]

The disturbed bench is the 30-class vehicle on its stand (kappa free, zeta known). Records have 6000
samples at 50 Hz, random steps and 2 mrad of measurement noise. The response to the disturbance is
as large as the driven one. FOLDER (runs/monte-carlo) stores a line for each run, so that an
interrupted study can continue. table.md and monte_carlo.svg cover all runs.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from heli_jax import Flight, Free, Problem, fit, load_vehicle, models, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.equation_error.rls import baseline
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.unknowns.layout import Noise, layout_of
from heli_jax.naming import asdict, names, replace
from heli_jax.simulation.inputs import random_steps

jax.config.update("jax_enable_x64", True)
N, DT, NOISE, SIGMA_W, TAU_W = 6000, 0.02, 2e-3, 1.04, 1.0
FREE = {"Ixx": Free(0.03), "If": Free(2.5e-4), "kappa": Free(3.0)}
MODEL = with_disturbance(models.roll_on_stand, "roll")
METHODS = ("filter error", "output error, white", "output error, autocorrelated", "RLS")


def truth() -> Any:
    vehicle = load_vehicle(Path(__file__).parents[1] / "configs" / "vehicles" / "bench-30.yaml")
    noise = {"sigma_w": jnp.asarray(SIGMA_W), "tau_w": jnp.asarray(TAU_W)}
    return MODEL.Params(**asdict(vehicle), **noise)


@jax.jit
def response(params: Any, u: jax.Array, key: jax.Array) -> jax.Array:
    return simulate(MODEL, params, MODEL.Inputs(x_roll=u), dt=DT, key=key).outputs.roll


def record(params: Any, seed: int) -> Flight:
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
    roll = np.asarray(response(params, jnp.asarray(u), jax.random.key(seed)))
    y = roll + NOISE * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})


def one_run(params: Any, seed: int) -> dict[str, Any]:
    """Return every method's result for one record: value, sd and seconds; None if there is none."""
    flight = record(params, seed)
    start = replace(params, sigma_w=jnp.asarray(0.0), tau_w=jnp.asarray(0.3))
    out: dict[str, Any] = {"seed": seed}
    for method in ("filter-error", "output-error"):
        begin = time.perf_counter()
        result = fit(Problem(MODEL, start, [flight], FREE, method=method))
        seconds = time.perf_counter() - begin
        for name in METHODS:
            if not name.startswith(method.replace("-", " ")):
                continue
            sds = {n: e.sd_white if "white" in name else e.sd for n, e in result.estimates.items()}
            reported = {n: (e.lower95, e.upper95) for n, e in result.estimates.items()}
            out[name] = {
                "status": result.status,
                "steps": result.steps,
                "seconds": seconds,
                "values": {n: e.value for n, e in result.estimates.items()},
                "sd": sds,
                "interval": {} if "white" in name else reported,
            }
    begin = time.perf_counter()
    ratios = baseline(models.roll_on_stand, undisturbed(params), flight).combinations
    values = {n: float(params.a) / ratios[f"a/{n}"] for n in ("Ixx", "If") if f"a/{n}" in ratios}
    usable = all(np.isfinite(v) and v > 0 for v in values.values()) and len(values) == 2
    out["RLS"] = {
        "status": "converged" if usable else "no physical parameters",
        "steps": 0,
        "seconds": time.perf_counter() - begin,
        "values": values,
        "sd": dict.fromkeys(values),
    }
    return out


def undisturbed(params: Any) -> Any:
    """Return the parameters of the model without its disturbance."""
    plain = models.roll_on_stand.Params
    return plain(**{n: getattr(params, n) for n in names(plain)})


def fisher(params: Any, records: int = 5) -> dict[str, float]:
    """Return the relative Cramer-Rao sd of filter error at the truth (for unbiased methods)."""
    free = {n: Free(float(getattr(params, n))) for n in FREE}
    sds = []
    for seed in range(records):
        problem = Problem(MODEL, params, [record(params, seed)], free, method="filter-error")
        layout = layout_of(problem, problem.training)
        data = data_of(problem, problem.training)
        z = start_vector(layout, data, problem)
        dtype = z.dtype
        noise = Noise(({"roll": np.asarray(NOISE, dtype)},), np.zeros((), dtype))
        sds.append(deviations(evaluate(layout, data, noise, z).J)[: len(FREE)])
    mean = np.sqrt(np.mean(np.square(sds), axis=0))
    return dict(zip(FREE, (float(v) for v in mean), strict=True))


def rows(runs: list[dict[str, Any]], params: Any, bound: dict[str, float]) -> list[dict[str, Any]]:
    table = []
    for method in METHODS:
        done = [r[method] for r in runs if r[method]["status"] == "converged"]
        for name in FREE:
            values = np.array([d["values"][name] for d in done if name in d["values"]])
            if values.size == 0:
                continue
            true = float(getattr(params, name))
            sds = np.array([d["sd"][name] or np.nan for d in done if name in d["values"]])
            # Intervals as reported; for white noise log-normal ones, as in `fit`.
            inside = np.abs(np.log(np.maximum(values / true, 1e-300))) < 1.96 * sds / values
            if all(d.get("interval") for d in done):
                # Only fits that did not withdraw their interval.
                ends = [d["interval"][name] for d in done]
                inside = np.array([low < true < high for low, high in ends if low is not None])
            spread = values.std(ddof=1)
            table.append(
                {
                    "method": method,
                    "parameter": name,
                    "bias": (values.mean() - true) / true,
                    "bias_in_sd": (values.mean() - true) / spread,
                    "rmse": np.sqrt(np.mean((values / true - 1.0) ** 2)),
                    "rmse_over_fisher": np.sqrt(np.mean((values / true - 1.0) ** 2)) / bound[name],
                    "claimed_over_empirical": np.sqrt(np.mean(sds**2)) / spread,
                    "coverage": inside.mean() if inside.size and np.isfinite(sds).all() else np.nan,
                    "failures": len(runs) - len(done),
                    "steps_99": np.percentile([d["steps"] for d in done], 99),
                    "seconds": np.median([d["seconds"] for d in done]),
                }
            )
    return table


def markdown(table: list[dict[str, Any]], count: int) -> str:
    head = (
        "| method | parameter | bias | bias/sd | RMSE | RMSE/Fisher | claimed/empirical sd "
        "| coverage of 95 % | failures | steps (99 %) | time [s] |"
    )
    lines = [f"{count} runs of {N} samples, disturbance as large as the response.", "", head]
    lines.append("|" + "---|" * 11)
    for r in table:
        coverage = "none claimed" if np.isnan(r["coverage"]) else f"{100 * r['coverage']:.1f} %"
        ratio = r["claimed_over_empirical"]
        claimed = "" if np.isnan(ratio) else f"{ratio:.2f}"
        lines.append(
            f"| {r['method']} | {r['parameter']} | {100 * r['bias']:+.2f} % | "
            f"{r['bias_in_sd']:+.2f} | {100 * r['rmse']:.1f} % | "
            f"{r['rmse_over_fisher']:.2f} | {claimed} | {coverage} | "
            f"{r['failures']} | {r['steps_99']:.0f} | {r['seconds']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def figure(runs: list[dict[str, Any]], params: Any, path: Path) -> None:
    made = Figure(figsize=(7.4, 3.2), layout="constrained")
    for ax, name in zip(made.subplots(1, len(FREE)), FREE, strict=True):
        for i, method in enumerate(METHODS):
            done = [r[method] for r in runs if r[method]["status"] == "converged"]
            values = [d["values"].get(name, np.nan) for d in done]
            x = np.array(values) / float(getattr(params, name))
            ax.plot(x, i + np.linspace(-0.3, 0.3, x.size), ".", ms=3, alpha=0.6)
        ax.axvline(1.0, color="black", lw=0.8)
        ax.set_yticks(range(len(METHODS)), METHODS if name == "Ixx" else [""] * len(METHODS))
        ax.set_xscale("log")
        ax.set_xlabel(f"{name}, estimate over truth")
    made.savefig(path)


def main(count: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "runs.jsonl"
    kept = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    # Runs of earlier versions are kept. They call autocorrelated residuals coloured.
    kept = [line.replace("output error, coloured", METHODS[2]) for line in kept]
    runs = {r["seed"]: r for r in (json.loads(line) for line in kept)}
    params = truth()
    for seed in range(count):
        if seed in runs:
            continue
        runs[seed] = one_run(params, seed)
        with log.open("a", encoding="utf-8") as f:
            f.write(json.dumps(runs[seed]) + "\n")
        if seed % 10 == 9:
            print(f"{seed + 1} of {count} runs", file=sys.stderr, flush=True)
    chosen = [runs[s] for s in range(count)]
    text = markdown(rows(chosen, params, fisher(params)), count)
    (folder / "table.md").write_text(text, encoding="utf-8")
    figure(chosen, params, folder / "monte_carlo.svg")
    print(text, end="")


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__, "five minutes", Size("runs", 200, 2, "records"), out="runs/monte-carlo"
    )
    main(options.runs, options.out)
