"""Landings of the X-Cell 60 without its engine, and the height-velocity diagram.

    python experiments/autorotation.py [ENTRIES] [--quick] [--out FOLDER]

prints the open-loop optimum from 30 m and 100 m with a check by single shooting, gradients
through 20 s against finite differences, and the share of ENTRIES in wind that the feedback on
energy lands, with a first guess of its gains, after tuning, and with the gains of the package.
FOLDER has the figures landings.png and height-velocity.png.
"""

import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads wait for each other in small matrices

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from script import Size, asked

import heli_jax
from heli_jax import naming
from heli_jax.control import autorotation as ar

VEHICLE = Path(__file__).parent.parent / "configs" / "vehicles" / "x-cell-60.yaml"
SPEED, WIND, GUSTS = 15.0, 4.0, np.array([0.5, 0.5, 0.25])
"""Highest entry speed and steady wind, and sd of gusts with a time constant of 1 s [m/s]."""
UNHARMED = ar.Limits(vertical=1.5, horizontal=3.0)
"""Speeds at touchdown in the height-velocity diagram."""
FIRST_GUESS = ar.Gains(
    speed=7.5, sink=9.0, deceleration=22.0, settling=0.2, slowing=0.33,
    k_speed=0.65, k_sink=7.0, k_glide=0.8, k_rotor=6.6, k_energy=0.3,
)  # fmt: skip


def failures(
    model: Any, params: Any, height: Any, speed: Any, wind: Any, delay: float = 0.0
) -> Any:
    """Return the states (k,) at which landings begin; `wind` is (k, 2) [m/s]."""

    def one(h: Any, v: Any, w: Any) -> Any:
        return ar.engine_failure(model, params, h, v, (w[0], w[1], 0.0 * h), delay)

    entry = jax.jit(jax.vmap(one))(height, speed, wind)
    assert float(jnp.max(entry.residual)) < 1e-8
    return entry.state


def entries(
    model: Any, params: Any, heights: tuple[float, float], count: int, seed: int
) -> tuple[np.ndarray, Any, Any]:
    """Return heights, states and inputs of failures in gusts, and in wind from all directions."""
    rng, n = np.random.default_rng(seed), round(heights[1] / 4.0 / ar.DT)
    height = np.where(np.arange(count) % 2, heights[1], heights[0])
    speed, angle = rng.uniform(0.0, SPEED, count), rng.uniform(0.0, 2.0 * np.pi, count)
    size = WIND * np.sqrt(rng.uniform(0.0, 1.0, count))
    wind = np.stack([size * np.cos(angle), size * np.sin(angle)], 1)
    gusts, keep = np.zeros((count, 3, n)), np.exp(-ar.DT)
    steps = GUSTS[:, None] * np.sqrt(1.0 - keep**2) * rng.standard_normal((count, 3, n))
    for k in range(1, n):
        gusts[..., k] = keep * gusts[..., k - 1] + steps[..., k]
    gusts[:, :2] += wind[..., None]
    air = {f"wind_{a}": gusts[:, i] for i, a in enumerate("xyz")}
    zero = np.zeros((count, n))
    inputs = {k: jnp.asarray(air.get(k, zero)) for k in naming.names(model.Inputs)}
    return height, failures(model, params, height, speed, wind), model.Inputs(**inputs)


def touchdowns(model: Any, params: Any, gains: Any, states: Any, inputs: Any) -> ar.Touchdown:
    """Return the touchdowns (k,) of the feedback."""

    def one(s: Any, u: Any) -> Any:
        return ar.touchdown(params, ar.fly(model, params, gains, s, u))

    return jax.device_get(jax.vmap(one)(states, inputs))


def optimum(model: Any, params: Any, height: float) -> Any:
    """Print the optimum after a failure at 8 m/s, and that of single shooting."""
    entry = ar.engine_failure(model, params, height, 8.0)
    landing = ar.land(model, params, entry)
    S, K, M = ar.Grid()
    whole = ar.LandingProblem(model, params, entry, ar.Limits(), ar.CALM, ar.Grid(1, S * K, M))
    start = ar.fly(model, params, FIRST_GUESS, entry.state, ar.calm(model, 30.0))
    _, single = whole.minimised(whole.sampled(start), 3000)
    end = jax.tree.map(lambda v: float(v[-1]), landing.trajectory.states)
    print(
        f"{height:g} m: {landing.message}, {landing.steps} steps, converged {landing.converged}\n"
        f"  cost {landing.cost:.5f}, violation {landing.violation:.1e}, touchdown {end.dz:.3f} m/s "
        f"up, {end.dx:.3f} m/s forward, pitch {end.theta:.3f} rad, rotor "
        f"{end.Omega / float(params.Omega):.2f}\n  single shooting: cost {single.fun:.5f} "
        f"({100 * (single.fun / landing.cost - 1):+.2f} %), {single.nit} steps, {single.message}",
        flush=True,
    )
    return landing.trajectory


def gradients(model: Any, params: Any) -> float:
    """Return the largest relative error of gradients through 20 s by the gains."""
    entry, inputs = ar.engine_failure(model, params, 200.0, 5.0), ar.calm(model, 20.0)

    @jax.jit
    def end(z: Any) -> Any:
        s = ar.fly(model, params, ar.Gains(*z), entry.state, inputs).states
        return jnp.stack([v[-1] for v in (s.z, s.dx, s.dz, s.Omega)])

    z = jnp.asarray([float(g) for g in ar.Gains()])
    exact, steps = np.asarray(jax.jit(jax.jacfwd(end))(z)), 1e-5 * z
    differences = [
        (end(z.at[i].add(h)) - end(z.at[i].add(-h))) / (2.0 * h) for i, h in enumerate(steps)
    ]
    error = np.abs(exact - np.stack(differences, 1)).max(1)
    return float(np.max(error / np.abs(exact).max(1)))


def height_velocity(model: Any, params: Any, count: int, out: Path) -> None:
    """Draw the entries from which one of several feedbacks lands, after 0.5 s without reaction."""
    heights, speeds = np.geomspace(0.5, 50.0, count), np.linspace(0.0, 20.0, count)
    h, v = (a.ravel() for a in np.meshgrid(heights, speeds, indexing="ij"))
    states = failures(model, params, h, v, np.zeros((h.size, 2)), delay=0.5)
    calm = ar.calm(model, 14.0)
    inputs = jax.tree.map(lambda u: jnp.broadcast_to(u, (h.size, u.size)), calm)
    good, least = np.zeros(h.size, bool), np.full(h.size, np.inf)
    for settling in (1.0, 2.0, 4.0):
        for slowing in (1.0, 3.0, 9.0):
            g = ar.Gains()
            g = g._replace(settling=settling * g.settling, slowing=slowing * g.slowing)
            ends = touchdowns(model, params, g, states, inputs)
            good |= np.asarray(ends.good(UNHARMED))
            landed = np.asarray(ends.height) < 1e-3
            least = np.where(landed, np.minimum(least, np.hypot(ends.up, ends.forward)), least)
    good, speed = good.reshape(count, count), least.reshape(count, count)
    for height, row in zip(heights[::-1], good[::-1], strict=True):
        print(f"{height:6.1f} m  " + "".join("#."[int(g)] for g in row))
    print(f"          0 to {speeds[-1]:g} m/s; # marks entries without an unharmed touchdown")
    figure, axes = plt.subplots(figsize=(6, 4.5), layout="constrained")
    filled = axes.contourf(speeds, heights, np.minimum(speed, 6.0), np.linspace(0, 6, 13))
    axes.contour(speeds, heights, good.astype(float), [0.5], colors="white")
    axes.set(xlabel="speed [m/s]", ylabel="height [m]", yscale="log")
    figure.colorbar(filled, label="speed at touchdown [m/s]")
    figure.savefig(out / "height-velocity.png", dpi=150)


def draw(runs: dict[str, Any], params: Any, out: Path) -> None:
    """Draw flights by name."""
    labels = ("height [m]", "forward [m/s]", "vertical [m/s]", "rotor speed [1]", "collective [1]")
    figure, axes = plt.subplots(5, 1, figsize=(7, 9), sharex=True, layout="constrained")
    for name, run in runs.items():
        n = int(np.searchsorted(run.times, min(float(run.ended), float(run.times[-1])))) + 1
        s, u = run.states, run.inputs
        values = (s.z, s.dx, s.dz, s.Omega / params.Omega, u.x_collective)
        for ax, label, value in zip(axes, labels, values, strict=True):
            ax.plot(run.times[:n], value[:n], label=name)
            ax.set_ylabel(label)
    axes[0].legend()
    axes[-1].set_xlabel("time [s]")
    figure.savefig(out / "landings.png", dpi=150)


def main() -> None:
    size = Size("entries", 200, 20, "entries in wind")
    options = asked(__doc__, "eight minutes", size, out="runs/autorotation")
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    params, model = heli_jax.load_vehicle(VEHICLE), heli_jax.models.helicopter(wind=True)
    runs = {f"optimum, {h:g} m": optimum(model, params, h) for h in (30.0, 100.0)}
    for h in (30.0, 100.0):
        state = ar.engine_failure(model, params, h, 8.0).state
        runs[f"feedback, {h:g} m"] = ar.fly(model, params, ar.Gains(), state, ar.calm(model, 30.0))
    draw(runs, params, options.out)
    print(f"gradients through 20 s: relative error {gradients(model, params):.1e}", flush=True)
    height, *flights = entries(model, params, (30.0, 100.0), options.entries, 1)
    training = entries(model, params, (30.0, 70.0), 48, 0)[1:]
    tuned = ar.tune(model, params, FIRST_GUESS, *training, max_steps=5 if options.quick else 18)
    print("tuned:", ", ".join(f"{n} {v:.3g}" for n, v in tuned._asdict().items()))
    for name, gains in (("first guess", FIRST_GUESS), ("tuned", tuned), ("Gains()", ar.Gains())):
        good = np.asarray(touchdowns(model, params, gains, *flights).good())
        low, high = (100 * good[height == h].mean() for h in (30.0, 100.0))
        share = f"{100 * good.mean():.1f} % ({low:.0f} % from 30 m, {high:.0f} % from 100 m)"
        print(f"{name}: lands {share} of {options.entries} entries", flush=True)
    height_velocity(model, params, 8 if options.quick else 20, options.out)


if __name__ == "__main__":
    main()
