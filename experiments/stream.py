"""Estimates on line on the bench: coverage, 'flown enough', and time per sample.

    .venv/bin/python experiments/stream.py [RUNS] [PART]

Records of 120 s at 50 Hz, with gusts as large as the stick's response and with white noise alone;
Ixx, If and kappa start off by a quarter. PART (all) is coverage, enough or time.

Coverage: 95 % intervals after 20, 60 and 100 s, which are one, three and five blocks. Enough: at
the first block after which the sd of Ixx is at most the wanted one, the batch fit (filter error in
gusts, else output error) of the same samples states its own sd. Time: 100 s at 1 kHz, sample by
sample.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from monte_carlo import DT, FREE, MODEL, NOISE, N, record, truth, undisturbed

from heli_jax import Flight, Problem, fit, models, simulate, stream
from heli_jax.naming import replace

TRUE = truth()
CALM = replace(TRUE, sigma_w=jnp.asarray(0.0))
NAMES = tuple(FREE)
MOMENTS = (20.0, 60.0, 100.0)
WANTED = {"gusts": 0.055, "white noise": 0.0019}
"""Wanted relative sd of Ixx."""
_FOLLOW = jax.jit(stream.follow)


def problem_of(flight: Flight) -> Problem:
    """Return the problem on line, of the model without its disturbance."""
    return Problem(
        models.roll_on_stand, undisturbed(TRUE), [flight], FREE, method="frequency-error"
    )


def part_of(flight: Flight, first: int, last: int) -> Flight:
    u, y = flight.inputs["x_roll"][first:last], flight.outputs["roll"][first:last]
    return Flight(dt=flight.dt, inputs={"x_roll": u}, outputs={"roll": y})


def samples_of(flight: Flight) -> stream.Sample:
    return stream.Sample(
        jnp.asarray(flight.inputs["x_roll"])[:, None], jnp.asarray(flight.outputs["roll"])[:, None]
    )


def coverage(runs: int) -> None:
    true = np.array([float(getattr(TRUE, n)) for n in NAMES])
    print("| record | after [s] | " + " | ".join(f"{n}: RMSE, stated, covered" for n in NAMES))
    print("|---|---|" + "---|" * len(NAMES))
    for label, params in (("gusts", TRUE), ("white noise", CALM)):
        found = []
        for seed in range(runs):
            flight = record(params, seed)
            problem = problem_of(flight)
            state, known, at, row = stream.init(problem), None, 0, []
            for moment in MOMENTS:
                # One sample more completes the block.
                last = round(moment / DT) + 2
                state, _ = _FOLLOW(state, samples_of(part_of(flight, at, last)))
                at, known = last, stream.estimate(problem, state, known)
                assert known is not None
                each = [known.estimates[n] for n in NAMES]
                row.append([(e.value, e.sd, e.lower95, e.upper95) for e in each])
            found.append(row)
        value, sd, low, high = np.moveaxis(np.array(found), -1, 0)
        for i, moment in enumerate(MOMENTS):
            cells = []
            for j in range(len(NAMES)):
                v = value[:, i, j] / true[j]
                inside = (low[:, i, j] < true[j]) & (true[j] < high[:, i, j])
                rmse = 100.0 * np.sqrt(np.mean((v - 1.0) ** 2))
                stated = 100.0 * np.median(sd[:, i, j] / value[:, i, j])
                cells.append(f"{rmse:.3g} %, {stated:.3g} %, {100 * inside.mean():.0f} %")
            print(f"| {label} | {moment:g} | " + " | ".join(cells) + " |", flush=True)


def enough(runs: int) -> None:
    for label, params in (("white noise", CALM), ("gusts", TRUE)):
        wanted, ratios, when = WANTED[label], [], []
        for seed in range(runs):
            flight = record(params, 1000 + seed)
            problem = problem_of(flight)
            state, known = stream.init(problem), None
            at = 0
            for last in range(state.length + 2, N, state.length):
                # The first samples of the next block complete one.
                state, _ = _FOLLOW(state, samples_of(part_of(flight, at, last)))
                at = last
                known = stream.estimate(problem, state, known)
                if known is not None and known.sd_of("Ixx") <= wanted:
                    batch = part_of(flight, 0, last)
                    gusts = label == "gusts"
                    model = MODEL if gusts else models.roll_on_stand
                    start = replace(TRUE, sigma_w=jnp.asarray(0.0), tau_w=jnp.asarray(0.3))
                    vehicle = start if gusts else undisturbed(TRUE)
                    method = "filter-error" if gusts else "output-error"
                    e = fit(Problem(model, vehicle, [batch], FREE, method=method)).estimates["Ixx"]
                    ratios.append((e.sd or np.inf) / e.value / wanted)
                    when.append(last * DT)
                    break
        right = np.mean(np.array(ratios) <= 1.0)
        print(
            f"{label}: Ixx within {100 * wanted:g} % after {np.median(when):.0f} s (median of "
            f"{len(when)} of {runs} runs); the batch fit has it in {100 * right:.0f} % of them, "
            f"its sd is {np.median(ratios):.2f} of the wanted one",
            flush=True,
        )


def seconds_a_sample() -> None:
    dt, n = 1e-3, 100_000
    rng = np.random.default_rng(0)
    u = 3e-6 * np.repeat(rng.uniform(-1.0, 1.0, n // 400), 400)
    params = undisturbed(TRUE)
    inputs = models.roll_on_stand.Inputs(x_roll=jnp.asarray(u))
    y = np.array(simulate(models.roll_on_stand, params, inputs, dt=dt).outputs.roll)
    y += NOISE * rng.standard_normal(n)
    flight = Flight(dt=dt, inputs={"x_roll": u}, outputs={"roll": y})
    problem = problem_of(flight)
    state, known = stream.init(problem), None
    step = jax.jit(stream.step, donate_argnums=0)
    state, _ = step(state, stream.Sample(u[:1], y[:1]))
    begin, longest = time.perf_counter(), 0.0
    for k in range(1, n):
        state, _ = step(state, stream.Sample(u[k : k + 1], y[k : k + 1]))
        if k % 20_000 == 20 and k > 20:
            called = time.perf_counter()
            known = stream.estimate(problem, state, known)
            longest = max(longest, time.perf_counter() - called) if k > 20_020 else 0.0
            if k == 20_020:  # without compilation
                begin += time.perf_counter() - called
    jax.block_until_ready(state)
    spent = time.perf_counter() - begin
    print(f"1 kHz: {1e3 * spent / n:.3f} ms a sample with estimates; one takes {longest:.2f} s")


def main(runs: int, part: str) -> None:
    if part in ("all", "coverage"):
        coverage(runs)
    if part in ("all", "enough"):
        enough(runs)
    if part in ("all", "time"):
        seconds_a_sample()


if __name__ == "__main__":
    from script import Size, asked

    options = asked(
        __doc__,
        "ten minutes",
        Size("runs", 100, 2, "records with gusts, and without"),
        Size("part", "all", "all", "coverage, enough or time"),
    )
    main(options.runs, options.part)
