"""Landings of the X-Cell 60 without its engine, and the height-velocity diagram.

    python experiments/autorotation.py [ENTRIES] [--quick] [--out FOLDER]

prints the open-loop optimum from 30 m and 100 m with a check by SciPy's trust-constr, the share of
ENTRIES in wind that the feedback on energy lands, before and after tuning, and gradients through
20 s against finite differences. FOLDER has the figures landings.png and height-velocity.png.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize
from script import Size, asked

import heli_jax
from heli_jax import naming
from heli_jax.control import autorotation as ar

ROOT = Path(__file__).parent.parent
SPEED, WIND, GUSTS = 15.0, 4.0, 0.5
"""Highest entry speed and steady wind, and sd of gusts with a time constant of 1 s [m/s]."""
FIRST_GUESS = ar.Gains(
    speed=10.0, sink=6.0, deceleration=5.0, settling=0.3, slowing=1.5,
    k_speed=0.2, k_sink=4.0, k_glide=1.0, k_rotor=6.0, k_energy=0.1,
)  # fmt: skip


class Entries(NamedTuple):
    """Engine failures; arrays (k,), inputs (k, N)."""

    height: Any
    speed: Any
    wind: Any
    state: Any
    inputs: Any


def entries(model: Any, params: Any, count: int, seed: int) -> Entries:
    """Return failures at 30 m and 100 m by turns, in steady wind from all directions and gusts."""
    rng, n = np.random.default_rng(seed), round(24.0 / ar.DT) + 1
    height = np.where(np.arange(count) % 2, 100.0, 30.0)
    speed = rng.uniform(0.0, SPEED, count)
    angle, size = rng.uniform(0.0, 2.0 * np.pi, count), WIND * np.sqrt(rng.uniform(0.0, 1.0, count))
    wind = np.stack([size * np.cos(angle), size * np.sin(angle)], 1)
    gusts, keep = np.zeros((count, 3, n)), np.exp(-ar.DT)
    for k in range(1, n):
        gusts[..., k] = keep * gusts[..., k - 1]
        gusts[..., k] += GUSTS * np.sqrt(1.0 - keep**2) * rng.standard_normal((count, 3))
    entry = failures(model, params, height, speed, wind)
    air = {f"wind_{a}": gusts[:, i] + (wind[:, i, None] if i < 2 else 0.0) for i, a in enumerate("xyz")}
    zero = np.zeros((count, n))
    inputs = model.Inputs(**{k: jnp.asarray(air.get(k, zero)) for k in naming.names(model.Inputs)})
    return Entries(height, speed, wind, entry.state, inputs)


def failures(
    model: Any, params: Any, height: np.ndarray, speed: np.ndarray, wind: np.ndarray, delay: float = 0.0
) -> Any:
    """Return the entries (k,)."""

    def one(h: Any, v: Any, w: Any) -> Any:
        return ar.engine_failure(model, params, h, v, wind=(w[0], w[1], 0.0 * h), reaction=delay)

    entry = jax.jit(jax.vmap(one))(height, speed, wind)
    assert float(jnp.max(entry.residual)) < 1e-8
    return entry


def flown(model: Any, params: Any, gains: Any, state: Any, inputs: Any) -> ar.Touchdown:
    """Return the touchdowns (k,) of the feedback."""

    def one(s: Any, u: Any) -> Any:
        return ar.touchdown(params, ar.fly(model, params, gains, s, u))

    return jax.device_get(jax.jit(jax.vmap(one))(state, inputs))


def optimum(model: Any, params: Any, height: float, iterations: int) -> heli_jax.Trajectory:
    """Print the optimum after a failure at 8 m/s, and that of trust-constr from another start."""
    entry = ar.engine_failure(model, params, height, 8.0)
    landing = ar.land(model, params, entry)
    problem = ar.LandingProblem(model, params, entry)
    start = ar.fly(model, params, FIRST_GUESS, entry.state, ar.calm(model, 30.0))
    _, other = problem.minimised(problem.sampled(start), "trust-constr", maxiter=iterations)
    end = landing.touchdown
    print(
        f"{height:g} m: {'converged' if landing.converged else 'NOT CONVERGED'} in {landing.steps} "
        f"steps, cost {landing.cost:.5f}, defect {landing.defect:.1e}; touchdown "
        f"{end['dz']:.3f} m/s vertical, {end['dx']:.3f} m/s forward, pitch {end['theta']:.3f} rad, "
        f"rotor {end['Omega'] / float(params.Omega):.2f}\n  trust-constr: cost {other.fun:.5f} "
        f"({100 * (other.fun / landing.cost - 1):+.2f} %), violation {other.constr_violation:.1e}, "
        f"{other.nit} steps",
        flush=True,
    )
    return landing.trajectory


def shares(ends: ar.Touchdown, heights: np.ndarray) -> str:
    """Return the shares of good touchdowns in words."""
    good = np.asarray(ends.good())
    low, high = (100 * good[heights == h].mean() for h in (30.0, 100.0))
    return f"{100 * good.mean():.1f} % ({low:.0f} % from 30 m, {high:.0f} % from 100 m)"


def gradients(model: Any, params: Any) -> float:
    """Return the largest relative difference of gradients through 20 s, by the gains."""
    entry = ar.engine_failure(model, params, 160.0, 5.0)
    inputs = ar.calm(model, 20.0)

    @jax.jit
    def end(z: Any) -> Any:
        run = ar.fly(model, params, ar.Gains(*z), entry.state, inputs)
        return jnp.stack([v[-1] for v in (run.states.z, run.states.dx, run.states.dz, run.states.Omega)])

    z = jnp.asarray([float(g) for g in ar.Gains()])
    exact, steps = jax.jit(jax.jacfwd(end))(z), 1e-5 * z
    differences = [
        (end(z.at[i].add(h)) - end(z.at[i].add(-h))) / (2.0 * h) for i, h in enumerate(steps)
    ]
    error = np.abs(np.asarray(exact) - np.stack(differences, 1)).max(1)
    return float(np.max(error / np.abs(exact).max(1)))


def height_velocity(model: Any, params: Any, count: int, out: Path) -> None:
    """Draw the entries from which the feedback lands, after a reaction of half a second."""
    heights, speeds = np.geomspace(1.0, 60.0, count), np.linspace(0.0, 20.0, count)
    h, v = (a.ravel() for a in np.meshgrid(heights, speeds, indexing="ij"))
    entry = failures(model, params, h, v, np.zeros((h.size, 2)), delay=0.5)
    calm = ar.calm(model, 20.0)
    inputs = jax.tree.map(lambda u: jnp.broadcast_to(u, (h.size, u.size)), calm)
    ends = flown(model, params, ar.Gains(), entry.state, inputs)
    good = np.asarray(ends.good()).reshape(count, count)
    for i in range(count - 1, -1, -1):
        print(f"{heights[i]:6.1f} m  " + "".join(".#"[int(not g)] for g in good[i]))
    print(f"          0 to {speeds[-1]:g} m/s; # has no good touchdown")
    figure, axes = plt.subplots(figsize=(6, 4.5), layout="constrained")
    speed = np.hypot(np.asarray(ends.vertical), np.asarray(ends.forward)).reshape(count, count)
    filled = axes.contourf(speeds, heights, np.minimum(speed, 6.0), np.linspace(0, 6, 13))
    axes.contour(speeds, heights, good.astype(float), [0.5], colors="white")
    axes.set(xlabel="speed [m/s]", ylabel="height [m]", yscale="log")
    figure.colorbar(filled, label="speed at touchdown [m/s]")
    figure.savefig(out / "height-velocity.png", dpi=150)


def draw(runs: dict[str, Any], params: Any, out: Path) -> None:
    """Draw flights by name."""
    figure, axes = plt.subplots(5, 1, figsize=(7, 9), sharex=True, layout="constrained")
    for name, run in runs.items():
        n = int(np.searchsorted(run.times, min(float(run.ended), float(run.times[-1])))) + 1
        s, u = run.states, run.inputs
        for ax, value in zip(
            axes, (s.z, s.dx, s.dz, s.Omega / params.Omega, u.x_collective), strict=True
        ):
            ax.plot(run.times[:n], value[:n], label=name)
    labels = ("height [m]", "forward [m/s]", "vertical [m/s]", "rotor speed [1]", "collective [1]")
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylabel(label)
    axes[0].legend()
    axes[-1].set_xlabel("time [s]")
    figure.savefig(out / "landings.png", dpi=150)


def main() -> None:
    options = asked(
        __doc__,
        "eight minutes",
        Size("entries", 200, 20, "entries in wind"),
        out="runs/autorotation",
    )
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    params = heli_jax.load_vehicle(ROOT / "configs" / "vehicles" / "x-cell-60.yaml")
    model = heli_jax.models.helicopter(wind=True)
    runs = {f"optimum from {h:g} m": optimum(model, params, h, 1000) for h in (30.0, 100.0)}
    for h in (30.0, 100.0):
        entry = ar.engine_failure(model, params, h, 8.0)
        calm = ar.calm(model, 30.0)
        runs[f"feedback from {h:g} m"] = ar.fly(model, params, ar.Gains(), entry.state, calm)
    draw(runs, params, options.out)
    print(f"gradients through 20 s: relative difference {gradients(model, params):.1e}", flush=True)
    tests = entries(model, params, options.entries, 1)
    for name, gains in {"first guess": FIRST_GUESS, "Gains()": ar.Gains()}.items():
        ends = flown(model, params, gains, tests.state, tests.inputs)
        print(f"{name}: {shares(ends, tests.height)} of {options.entries} entries", flush=True)
    height_velocity(model, params, 8 if options.quick else 20, options.out)


if __name__ == "__main__":
    main()
