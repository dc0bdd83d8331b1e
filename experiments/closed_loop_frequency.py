"""The R-50 in closed loop in the frequency domain: with instruments, directly, and by filter error.

    .venv/bin/python experiments/closed_loop_frequency.py [RUNS] [METHODS]

Each of RUNS (40) runs has four records of 90 s. A pilot barely keeps the hover, and gusts act on
six axes. A logged sweep of 0.05 to 4 Hz is added to one cyclic stick. Free parameters are 14
derivatives of the attitude, 6 of the speed and the delays of both sticks. Starts are off by up to a
factor of 1.5. The records are made with SciPy's matrix exponentials. The folder of --out stores a
line for each fit, so that an interrupted run can continue.
"""

import functools
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.signal
from r50_record import AXES, NOISE, SIGMA, truth, turbulent

from heli_jax import Flight, Free, Nuisance, Problem, fit, linear_model, naming, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.onboard.delays import with_delays

jax.config.update("jax_enable_x64", True)
DT, SECONDS, SWEEP, BAND = 0.02, 90.0, 0.15, (0.05, 4.0)
ATTITUDE = ("Lb", "Ma", "tau_f", "Ab", "Ac", "Alat", "Alon", "Ba", "Bd", "Blat", "Blon")
ATTITUDE = (*ATTITUDE, "tau_s", "Clon", "Dlat")
SPEED = ("Xu", "Yv", "Lu", "Lv", "Mu", "Mv")
DELAYS = {"delay_lat": 0.033, "delay_lon": 0.047}
OUTPUTS = ("u", "v", "p", "q", "phi", "theta")
GUSTS = 1.0
"""Factor of the turbulence of r50_record.py."""


class Step(NamedTuple):
    """One sample of the flight: x+ = A x + now u[k-d] + before u[k-d-1] + L noise."""

    A: np.ndarray
    now: np.ndarray
    before: np.ndarray
    whole: np.ndarray
    """Delay d of each input [samples]."""
    L: np.ndarray


@functools.cache
def step() -> Step:
    model, params = turbulent(), truth()
    A, B, _, _ = (np.asarray(m) for m in jacobians(model, params))
    n, m = B.shape

    def held(h: float) -> tuple[np.ndarray, np.ndarray]:
        E = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * h)
        return E[:n, :n], E[:n, n:]

    late = {"lat": DELAYS["delay_lat"], "lon": DELAYS["delay_lon"], "ped": float(params.tau_ped)}
    samples = np.array([late.get(name, 0.0) for name in naming.names(model.Inputs)]) / DT
    whole, (Ad, now) = np.floor(samples).astype(int), held(DT)
    before = np.zeros_like(B)
    for j, rest in enumerate((samples - whole) * DT):
        (_, early), (after, rest_of) = held(rest), held(DT - rest)
        before[:, j], now[:, j] = after @ early[:, j], rest_of[:, j]
    assert model.noise_intensity is not None
    g = np.array([float(v) for v in naming.asdict(model.noise_intensity(params)).values()])
    # Van Loan (1978): covariance of the noise of one sample.
    E = scipy.linalg.expm(np.block([[-A, np.diag(g**2)], [np.zeros((n, n)), A.T]]) * DT)
    values, vectors = np.linalg.eigh(E[n:, n:].T @ E[:n, n:])
    return Step(Ad, now, before, whole, vectors * np.sqrt(np.maximum(values, 0.0)))


@functools.cache
def pilot() -> np.ndarray:
    """Return gains (4, 13) of a quadratic regulator with expensive sticks.

    It mirrors unstable modes and hardly changes the others.
    """
    one = step()
    A, B = one.A[:13, :13], (one.now + one.before)[:13]
    weights = {"phi": 1.0, "theta": 1.0, "p": 0.05, "q": 0.05, "u": 0.01, "v": 0.01}
    Q = np.diag([weights.get(n, 1e-4) for n in naming.names(turbulent().State)[:13]])
    R = 10.0 * np.diag([10.0, 10.0, 10.0, 3.0])
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def sweep(N: int) -> np.ndarray:
    t = DT * np.arange(N)
    fade = np.minimum(1.0, np.minimum(t, t[::-1]) / 2.0)
    # Starts as a sine, so that the first value is zero.
    return SWEEP * fade * scipy.signal.chirp(t, BAND[0], t[-1], BAND[1], "logarithmic", -90)


def record(seed: int, stick: str) -> Flight:
    """Return a flight in closed loop with a sweep on one stick, logged as its instrument."""
    model, one, rng = turbulent(), step(), np.random.default_rng(seed)
    N, n, names = round(SECONDS / DT), step().A.shape[0], naming.names(turbulent().Inputs)
    added = np.zeros((N, 4))
    added[:, names.index(stick)] = sweep(N)
    x, sticks, states = np.zeros(n), np.zeros((N, 4)), np.zeros((N, n))
    x[13:] = GUSTS * rng.standard_normal(6) * [SIGMA[a] for a in AXES]
    columns = np.arange(4)
    for k in range(N):
        states[k] = x
        sticks[k] = added[k] - pilot() @ x[:13]
        # The first sample is held before the record, as in the package.
        now = sticks[np.maximum(k - one.whole, 0), columns]
        before = sticks[np.maximum(k - one.whole - 1, 0), columns]
        x = one.A @ x + one.now @ now + one.before @ before
        x += GUSTS * one.L @ rng.standard_normal(n)
    at = naming.names(model.State)
    return Flight(
        dt=DT,
        inputs=dict(zip(names, sticks.T, strict=True)),
        outputs={o: states[:, at.index(o)] + NOISE[o] * rng.standard_normal(N) for o in OUTPUTS},
        instruments={o: added[:, names.index(o)] for o in ("lat", "lon")},
        name=f"{stick}-{seed}",
    )


@functools.cache
def models() -> tuple[Any, Any]:
    """Return the models without and with a disturbance on each axis."""
    bare = with_delays(linear_model("r50-hover").model, inputs=["lat", "lon"])
    return bare, with_disturbance(bare, ["p", "q", "u", "v"])


def truths() -> dict[str, float]:
    values = naming.asdict(linear_vehicle())
    return {n: float(values[n]) for n in (*ATTITUDE, *SPEED)} | DELAYS


def problem(seed: int, method: str, **more: Any) -> Problem:
    rng = np.random.default_rng(10_000 + seed)
    flights = [record(100 * seed + i, ("lat", "lon")[i % 2]) for i in range(4)]
    model = models()[1 if method == "filter-error" else 0]
    values = naming.asdict(linear_vehicle()) | DELAYS
    free = {
        n: Free(v * float(np.exp(rng.uniform(-1, 1) * np.log(1.5)))) for n, v in truths().items()
    }
    return Problem(
        model,
        model.Params(**values),
        flights,
        free,
        Nuisance(initial_state=False, bias=False, input_offset=False),
        method=method,
        **more,
    )


METHODS: dict[str, dict[str, Any]] = {
    "by instrument": {"method": "frequency-error"},
    "direct": {"method": "frequency-error", "instrument": ()},
    "filter error": {"method": "filter-error"},
}


def linear_vehicle() -> Any:
    """Return the parameters of the model without delays of its inputs."""
    return linear_model("r50-hover").vehicle().params


def doublet(model: Any, stick: str, N: int) -> Any:
    """Return inputs (N,) with a doublet on one stick."""
    u = np.zeros(N)
    u[25:50], u[50:75] = 0.1, -0.1
    return model.Inputs(**{n: u if n == stick else np.zeros(N) for n in naming.names(model.Inputs)})


def doublet_tic(found: dict[str, float]) -> float:
    """Return the worse of Theil's coefficients for a doublet on each cyclic stick, in still air."""
    model, vehicle = models()[0], naming.asdict(linear_vehicle())
    N, worst = round(4.0 / DT), 0.0
    for stick in ("lat", "lon"):
        inputs = doublet(model, stick, N)
        y = [
            np.stack([np.asarray(getattr(run.outputs, n)) / NOISE[n] for n in OUTPUTS])
            for values in (truths(), found)
            for run in [simulate(model, model.Params(**{**vehicle, **values}), inputs, dt=DT)]
        ]
        rms = [np.sqrt(np.mean(v**2)) for v in (y[0] - y[1], y[0], y[1])]
        worst = max(worst, float(rms[0] / (rms[1] + rms[2])))
    return worst


def one_fit(seed: int, method: str) -> dict[str, Any]:
    """Return relative errors, errors over the stated sd, and the fit's findings."""
    asked = problem(seed, **METHODS[method])
    begin = time.perf_counter()
    found = fit(asked, starts=1)
    values = {n: e.value for n, e in found.estimates.items()}
    return {
        "seed": seed,
        "method": method,
        "status": found.status,
        "steps": found.steps,
        "seconds": found.timing["fit"],
        "all_seconds": time.perf_counter() - begin,
        "tic": doublet_tic(values),
        "untrusted": list(found.untrusted),
        "adequate": found.adequate,
        "error": {n: values[n] - t for n, t in truths().items()},
        "z": {n: (values[n] - t) / (found.estimates[n].sd or np.nan) for n, t in truths().items()},
    }


def table(fits: list[dict[str, Any]]) -> str:
    head = "method | runs | attitude: RMSE, covered | speed: RMSE, covered | delays: RMSE [ms], "
    head += "covered | TIC of a doublet, largest | fit [s]"
    lines = [f"| {head} |", "|---" * 7 + "|"]
    size = {n: abs(t) for n, t in truths().items()}
    for method in METHODS:
        those = [f for f in fits if f["method"] == method]
        if not those:
            continue
        cells = [method, str(len(those))]
        for names, unit in ((ATTITUDE, size), (SPEED, size), (tuple(DELAYS), {})):
            e = np.array([[f["error"][n] / unit.get(n, 1e-3) for n in names] for f in those])
            z = np.array([[f["z"][n] for n in names] for f in those], float)
            rmse = np.median(np.sqrt(np.mean(e**2, axis=0))) * (100 if unit else 1)
            covered = 100 * np.mean(np.abs(z) < 1.959963984540054)
            cells.append(f"{rmse:.2g}{' %' if unit else ''}, {covered:.0f} %")
        cells.append(f"{max(f['tic'] for f in those):.3f}")
        cells.append(f"{np.median([f['seconds'] for f in those]):.2f}")
        lines.append("| " + " | ".join(cells) + " |")
    direct = [f for f in fits if f["method"] == "direct"]
    if direct:
        share = {n: np.mean([n in f["untrusted"] for f in direct]) for n in size}
        flagged = ", ".join(f"{n} {100 * v:.0f}" for n, v in share.items())
        no = sum(not f["adequate"] for f in direct)
        lines.append(f"\nDirect: said to be untrusted, % of {len(direct)} runs: {flagged}.")
        lines.append(f"Called inadequate: {no} of them.")
    return "\n".join(lines)


def main(runs: int, out: Path, methods: list[str]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    lines = out / "fits.jsonl"
    done = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    known = {(f["seed"], f["method"]) for f in done}
    for seed in range(1, runs + 1):
        for method in methods:
            if (seed, method) in known:
                continue
            done.append(one_fit(seed, method))
            with lines.open("a") as file:
                file.write(json.dumps(done[-1]) + "\n")
            print(f"{seed} {method} {done[-1]['status']} {done[-1]['seconds']:.2f} s", flush=True)
    print(table([f for f in done if f["seed"] <= runs]))


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "an hour",
        Size("runs", 40, 2, "of four records each"),
        Size("methods", ",".join(METHODS), "by instrument,direct", "with commas between"),
        out="runs/closed-loop-frequency",
    )
    main(options.runs, options.out, options.methods.split(","))
