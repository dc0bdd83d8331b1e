"""Speed of the whole helicopter compared with C and SciPy in one run.

The consistent model from hover, 10 s at 50 Hz, RK4 with 4 steps a sample, small steps of all
sticks. It is compared with the same equations in C and in SciPy, and its derivatives with the
simulation itself.

All programs run on one core, set by the process affinity before JAX starts, so that JAX has one
thread like the C kernel. Times are CPU seconds, which other load affects least. Each pair runs in
turn, and the numbers are medians of times and ratios. Compilation covers trace to machine code.
"""

import ctypes
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from kernels import WIDE, compiled, pointer
from scipy.integrate import solve_ivp

from heli_jax import accumulate, load_vehicle, models, simulate, trim
from heli_jax.dynamics.model import Model
from heli_jax.fused.kernel import Kernel, lanes_for
from heli_jax.fused.traced import traced
from heli_jax.naming import asdict, replace
from heli_jax.simulation.accumulate import Steps, in_steps
from heli_jax.simulation.options import SimulationOptions

jax.config.update("jax_enable_x64", True)
VEHICLE = load_vehicle(Path(__file__).parents[2] / "configs" / "vehicles" / "x-cell-60.yaml")
MODEL = models.helicopter("consistent")
N, DT, SUBSTEPS = 500, 0.02, 4
TURNS = 9
"""Repetitions of each pair."""
VEHICLES, BLOCK = 1024, 128
JACOBIAN_BLOCK = 8
"""Vehicles per block of a Jacobian, each with twelve directions; limited by the caches."""
LANES = (8, 16, 32)
"""Vehicles per vector in C; the best number depends on the processor."""
IXX = np.linspace(0.8, 1.25, VEHICLES) * float(VEHICLE.Ixx)
STICK_STEPS = {"x_roll": 2e-4, "x_pitch": 2e-4, "x_yaw": 0.02, "x_throttle": 0.01}
FREE = (
    "Ixx", "Iyy", "Izz", "If", "m", "a", "a_T", "hr", "K_theta0", "K_theta0T", "K_throttle", "Sx",
)  # fmt: skip
IN_C = (
    "Iyy", "Izz", "Ir", "m", "g", "rho", "R", "c", "a", "B", "Cd0", "hr", "lr", "R_T", "c_T", "a_T",
    "L_T", "K_Omega", "K_theta0", "K_theta0T", "K_throttle", "If", "R1", "R2",
    "L1", "L2", "L3", "L4", "L5", "Sx", "Sy", "Sz",
)  # fmt: skip
"""The vehicle's constants in the order of the C kernel."""


class Run(NamedTuple):
    """Common start of all programs."""

    start: Any
    """State in hover."""
    inputs: Any
    """Sticks of hover with steps of half a second, one stick after another; arrays (N,)."""


def hover_and_steps(model: Model = MODEL, stick_steps: dict[str, float] = STICK_STEPS) -> Run:
    at, k = trim(model, VEHICLE), np.arange(N)
    sign = np.where(k // 100 % 2 == 0, 1.0, -1.0)
    steps = {
        n: jnp.asarray(float(getattr(at.inputs, n)) + size * sign * (k // 25 % 4 == i))
        for i, (n, size) in enumerate(stick_steps.items())
    }
    return Run(jax.tree.map(jnp.asarray, at.state), model.Inputs(**steps))


def compile_time(f: Callable[..., Any], *args: Any) -> tuple[Callable[..., Any], float]:
    """Return the compiled function and its compilation time [s]."""
    begin = time.process_time()
    program = jax.jit(f).lower(*args).compile()
    return program, time.process_time() - begin


def in_turn(
    ours: Callable[[], Any], theirs: Callable[[], Any], runs: int
) -> tuple[float, float, float]:
    """Return the medians of both times [s], measured in turn, and of their ratio."""
    times = []
    for f in [ours, theirs] * (runs + 1):
        begin = time.process_time()
        jax.block_until_ready(f())
        times.append(time.process_time() - begin)
    a, b = np.reshape(times, (-1, 2))[1:].T
    return float(np.median(a)), float(np.median(b)), float(np.median(a / b))


# The batch.


def batch(run: Run, model: Model = MODEL) -> Callable[[Array], Array]:
    """Return the sum of roll^2 of vehicles that differ in Ixx, in blocks, without storing runs."""

    def vehicle(Ixx: Array) -> Array:
        total, _ = accumulate(
            model,
            replace(VEHICLE, Ixx=Ixx),
            run.inputs,
            lambda total, out, _: total + out.roll**2,
            jnp.zeros(()),
            dt=jnp.asarray(DT),
            initial_state=run.start,
            solver="rk4",
            substeps=SUBSTEPS,
            adjoint=diffrax.ForwardMode(),
        )
        return total

    return lambda Ixx: jax.lax.map(vehicle, Ixx, batch_size=BLOCK)


def fused(run: Run, model: Model = MODEL) -> Callable[[], np.ndarray]:
    """Return the same batch as one program, as in sweeps."""

    def steps(vehicle: Any, inputs: Any, Ixx: Any) -> Steps:
        options = SimulationOptions(
            dt=jnp.asarray(DT), initial_state=run.start, solver="rk4", substeps=SUBSTEPS
        )
        return in_steps(
            model,
            replace(vehicle, Ixx=Ixx),
            inputs,
            lambda total, out, _: total + out.roll**2,
            jnp.zeros(()),
            options=options,
        )

    vehicle, Ixx = jax.tree.map(jnp.asarray, VEHICLE), jnp.asarray(IXX)
    whole = traced(steps, vehicle, run.inputs, Ixx[0])
    kernel = Kernel(whole.run, lanes_for(np.dtype(float)))
    begin = jax.jit(jax.vmap(lambda x: whole.own(vehicle, run.inputs, x)))
    common = whole.common(vehicle, run.inputs, Ixx[0])

    return lambda: whole.compute(kernel, begin(Ixx), common, run.inputs, 1).value


def in_c(
    run: Run, source: str = "helicopter.c", constants: tuple[str, ...] = IN_C
) -> Callable[[], np.ndarray]:
    """Return the same batch by the fastest build in C; `constants` are in the source's order."""
    builds = [
        built_in_c(run, source, constants, (f"-DLANES={lanes}", *width))
        for lanes in LANES
        for width in {(), WIDE}
    ]

    def least(build: Callable[[], Any]) -> float:
        build()
        return min(processor_time(build) for _ in range(3))

    return min(builds, key=least)


def processor_time(call: Callable[[], Any]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin


def built_in_c(
    run: Run, source: str, constants: tuple[str, ...], flags: tuple[str, ...]
) -> Callable[[], np.ndarray]:
    """Return one build of the C kernel."""
    kernel = compiled(source, flags)
    vehicle = np.array([float(getattr(VEHICLE, n)) for n in constants])
    start = np.array([float(v) for v in run.start])
    sticks = np.ascontiguousarray(np.stack([np.asarray(u) for u in run.inputs], axis=1))
    cost, size = np.zeros(VEHICLES), ctypes.c_size_t

    def call() -> np.ndarray:
        kernel.run(
            pointer(vehicle), pointer(IXX), pointer(start), pointer(sticks), pointer(cost),
            size(VEHICLES), size(N), ctypes.c_double(DT), ctypes.c_int(SUBSTEPS),
        )  # fmt: skip
        return cost

    return call


# SciPy: the same equations with NumPy's numbers, as usually written, and with plain Python's, which
# are fastest for one vehicle.


class Numbers(NamedTuple):
    """Functions and conversions of a right-hand side."""

    sin: Any
    cos: Any
    sqrt: Any
    of: Any
    """Conversion of SciPy's state array."""
    back: Any


NUMPY = Numbers(np.sin, np.cos, np.sqrt, lambda state: state, np.array)
PYTHON = Numbers(math.sin, math.cos, math.sqrt, lambda state: state.tolist(), lambda rates: rates)


def induced_velocity(V2: Any, W: Any, T0: Any, b: Any, sqrt: Any) -> Any:
    """Return the induced velocity by the package's Newton steps."""
    sign = -1.0 if T0 < 0 else 1.0
    c, t = sign * W, sign * T0
    q = 2 * c + b
    root = sqrt(q * q + 8 * t) + 1e-8
    axial = 2 * t / (q + root) if q > 0 else 0.25 * (root - q)
    x = min(axial, t / (2 * sqrt(V2 + 1e-16) + b + 1e-8))
    q = b - 2 * c
    if q > 0 and (inside := q * q - 8 * t) > 0:
        windmill = 2 * t / (q + sqrt(inside) + 1e-8)
        x = min(windmill, x) if 2.2 * windmill < -c else x
    for _ in range(7):
        below, above, w = -c - 0.5 * x, 2.2 * x + c, c + x
        q = max(below * above, 0.0)
        dq = 2.2 * below - 0.5 * above if q > 0 else 0.0
        ratio = q / (x * x + 5.8 * V2 + 1e-16)
        s2 = V2 + w * w + 0.37 * ratio * q + 1e-16
        s = sqrt(s2)
        ds2 = 2 * w + 0.74 * ratio * (dq - x * ratio)
        x -= s * (2 * x * s + b * x - t) / (2 * s2 + x * ds2 + b * s)
    return sign * x


def right_hand_side(v: dict[str, float], numbers: Numbers) -> Callable[..., Any]:
    """Return rates(t, state, sticks) of a vehicle, with precomputed factors."""
    (sin, cos, sqrt, of, back), pi, rho, B, R = numbers, math.pi, v["rho"], v["B"], v["R"]
    half = v["a"] * v["c"] / (pi * R)
    half_T, RK = v["a_T"] * v["c_T"] / (pi * v["R_T"]), v["R_T"] * v["K_Omega"]
    per_speed, lift = 0.5 * half * B**2 * R, half * B**3 / 3 * R**2 * v["K_theta0"]
    per_speed_T, lift_T = 0.5 * half_T * B**2 * RK, half_T * B**3 / 3 * RK**2 * v["K_theta0T"]
    area, area_T = rho * pi * R**2, rho * pi * v["R_T"] ** 2
    drag_Q, scale_Q = rho * R**4 * v["c"] * v["Cd0"] / 4, area * R * half
    lift_Q, B2 = B**3 / 3 * R * v["K_theta0"], B**2
    hub = rho * v["a"] * v["c"] * R**4 / 8
    bar = rho * v["a"] * v["c"] * (v["R2"] ** 4 - v["R1"] ** 4) / (8 * v["If"])
    link = v["L1"] * (v["L2"] + v["L3"])
    by_stick, by_bar = v["L3"] / link, v["L2"] * v["L4"] / link
    Ixx, Iyy, Izz, Ir, m, g = v["Ixx"], v["Iyy"], v["Izz"], v["Ir"], v["m"], v["g"]
    hr, lr, L_T, L5, K, drag = v["hr"], v["lr"], v["L_T"], v["L5"], v["K_throttle"], rho / 2 / m
    Sx, Sy, Sz = v["Sx"], v["Sy"], v["Sz"]

    def rates(t: float, state: Any, sticks: list[float]) -> Any:
        _, _, _, phi, theta, psi, dx, dy, dz, df, dt, ds, roll_bar, pitch_bar, Om = of(state)
        x_roll, x_pitch, x_yaw, x_throttle = sticks
        sf, cf, st, ct, sp, cp = sin(phi), cos(phi), sin(theta), cos(theta), sin(psi), cos(psi)
        ahead, aside = dx * cp + dy * sp, dy * cp - dx * sp
        below = ahead * st - dz * ct
        u, vb, w = ahead * ct + dz * st, aside * cf + below * sf, below * cf - aside * sf
        p, q, r = df - ds * st, dt * cf + ds * ct * sf, ds * ct * cf - dt * sf
        roll, pitch = by_stick * x_roll + by_bar * roll_bar, by_stick * x_pitch + by_bar * pitch_bar
        uh, vh, W, b = u - hr * q, vb + hr * p - lr * r, -(w + lr * q), per_speed * Om
        edge = uh * pitch - vh * roll
        T0 = lift * x_throttle * Om * Om + b * (edge - W)
        vi = induced_velocity(uh * uh + vh * vh, W, T0, b, sqrt)
        T, flow = area * (T0 - b * vi), W + vi
        lifting = lift_Q * Om * x_throttle - B2 / 2 * flow + B2 / 4 * edge
        torque = drag_Q * Om * Om + scale_Q * flow * lifting
        W, b = L_T * r - vb, per_speed_T * Om
        T0 = lift_T * x_yaw * Om * Om - b * W
        T_T = area_T * (T0 - b * induced_velocity(u * u + (w + L_T * q) ** 2, W, T0, b, sqrt))
        dp = (hub * Om * (Om * roll - p) - (Izz - Iyy) * q * r) / Ixx
        dq = (hub * Om * (Om * pitch - q) - T * lr - (Ixx - Izz) * r * p) / Iyy
        dr = (L_T * T_T + Ir * K * x_throttle - (Iyy - Ixx) * p * q) / Izz
        dds = (dq * sf + dr * cf + df * dt + ds * dt * st) / ct
        pull, slow = T / m, drag * sqrt(u * u + vb * vb + w * w)
        fu, fv, fw = slow * Sx * u, slow * Sy * vb, slow * Sz * w + pull
        aside, below = fv * cf - fw * sf, fv * sf + fw * cf
        ahead = fu * ct + below * st
        return back([
            dx, dy, dz, df, dt, ds,
            aside * sp - ahead * cp, -ahead * sp - aside * cp, below * ct - fu * st - g,
            dp + dds * st + ds * dt * ct, dq * cf - dr * sf - df * ds * ct, dds,
            bar * Om * (x_roll / L5 - roll_bar) - p, bar * Om * (x_pitch / L5 - pitch_bar) - q,
            K * x_throttle - torque / Ir,
        ])  # fmt: skip

    return rates


def first_vehicle() -> dict[str, float]:
    return {n: float(v) for n, v in asdict(VEHICLE).items()} | {"Ixx": float(IXX[0])}


def check_right_hand_side(run: Run) -> None:
    rng = np.random.default_rng(0)
    vehicle = replace(VEHICLE, Ixx=jnp.asarray(IXX[0]))
    for _ in range(20):
        x = np.array([float(v) for v in run.start]) + 0.3 * rng.standard_normal(len(run.start))
        u = [float(v[0]) for v in run.inputs]
        ours = MODEL.vector_field(vehicle, MODEL.State(*jnp.asarray(x)), MODEL.Inputs(*u))
        for numbers in (NUMPY, PYTHON):
            rates = right_hand_side(first_vehicle(), numbers)(0.0, x, u)
            np.testing.assert_allclose(rates, np.array(ours), rtol=1e-9, atol=1e-9)


def by_samples(run: Run, numbers: Numbers) -> float:
    """Return the sum of roll^2, with one call of solve_ivp per sample, as held inputs require."""
    rates, x = right_hand_side(first_vehicle(), numbers), np.array([float(v) for v in run.start])
    sticks = np.stack([np.asarray(u) for u in run.inputs], axis=1).tolist()
    cost = x[3] ** 2
    for u in sticks[:-1]:
        x = solve_ivp(rates, (0.0, DT), x, method="RK45", rtol=1e-6, args=(u,)).y[:, -1]
        cost += x[3] ** 2
    return float(cost)


def by_one_call(run: Run, numbers: Numbers) -> float:
    """Return the sum of roll^2 from one call, with steps of at most a sample."""
    rates, x = right_hand_side(first_vehicle(), numbers), np.array([float(v) for v in run.start])
    sticks = np.stack([np.asarray(u) for u in run.inputs], axis=1).tolist()
    times = DT * np.arange(N)

    def looked_up(t: float, state: Any) -> list[float]:
        return rates(t, state, sticks[int(t / DT)])

    ends = (0.0, float(times[-1]))
    solution = solve_ivp(looked_up, ends, x, method="RK45", rtol=1e-6, max_step=DT, t_eval=times)
    return float(np.sum(solution.y[3] ** 2))


# Derivatives.


def outputs(run: Run) -> Callable[[Array], Array]:
    """Return the outputs (13, N) of a vehicle as a function of twelve parameters."""

    def of(values: Array) -> Array:
        vehicle = replace(VEHICLE, **dict(zip(FREE, values, strict=True)))
        trajectory = simulate(
            MODEL, vehicle, run.inputs, dt=jnp.asarray(DT), initial_state=run.start,
            solver="rk4", substeps=SUBSTEPS, adjoint=diffrax.ForwardMode(),
        )  # fmt: skip
        return jnp.stack(trajectory.outputs)

    return of


def check_derivative(
    forward: Callable[[Array], Array], jacobian: Callable[[Array], Array], z: Array
) -> None:
    """Check the column of m against a central difference."""
    h = 1e-5 * z * (np.array(FREE) == "m")
    expected = (forward(z + h) - forward(z - h)) / (2 * h.sum())
    column = jacobian(z)[:, :, FREE.index("m")]
    np.testing.assert_allclose(
        column, expected, rtol=1e-5, atol=1e-5 * float(jnp.abs(expected).max())
    )


def main() -> None:
    run = hover_and_steps()
    rows: list[tuple[str, tuple[float, float, float], str]] = []
    seconds: dict[str, float] = {}

    Ixx, size = jnp.asarray(IXX), f"{VEHICLES} vehicles"
    ours, seconds[f"{size}, sum of roll^2"] = compile_time(batch(run), Ixx)
    theirs = in_c(run)
    np.testing.assert_allclose(ours(Ixx), theirs(), rtol=1e-9)
    rows.append((f"{size} / C", in_turn(lambda: ours(Ixx), theirs, TURNS), "<= 3"))
    begin = time.process_time()
    as_one = fused(run)
    seconds[f"{size}, one program"] = time.process_time() - begin
    np.testing.assert_allclose(as_one(), theirs(), rtol=1e-9)
    rows.append((f"{size}, one program / C", in_turn(as_one, theirs, TURNS), "<= 1"))

    check_right_hand_side(run)
    for name, alone in (("a sample", by_samples), ("a run", by_one_call)):
        for kind, numbers, target in (("NumPy", NUMPY, "<= 0.002"), ("Python", PYTHON, "")):
            np.testing.assert_allclose(alone(run, numbers), ours(Ixx)[0], rtol=1e-3)
            a, b, ratio = in_turn(
                lambda: ours(Ixx),
                lambda alone=alone, numbers=numbers: alone(run, numbers),
                min(TURNS, 5),
            )
            scaled = (a, VEHICLES * b, ratio / VEHICLES)
            title = f"{size} / as many solve_ivp, one call {name}, numbers of {kind}"
            rows.append((title, scaled, target))

    z = jnp.asarray([float(getattr(VEHICLE, n)) for n in FREE])
    zs = z * jnp.linspace(0.98, 1.02, BLOCK)[:, None]
    outputs_of = outputs(run)

    def blocks(zs: Array) -> Array:
        return jax.lax.map(jax.jacfwd(outputs_of), zs, batch_size=JACOBIAN_BLOCK)

    for name, f, slope, at in (
        ("1 vehicle", outputs_of, jax.jacfwd(outputs_of), z),
        (f"{BLOCK} vehicles", jax.vmap(outputs_of), blocks, zs),
    ):
        forward, seconds[f"{name}, outputs"] = compile_time(f, at)
        jacobian, seconds[f"{name}, outputs' Jacobian"] = compile_time(slope, at)
        if at is z:
            check_derivative(forward, jacobian, z)
        times = in_turn(lambda f=jacobian, at=at: f(at), lambda f=forward, at=at: f(at), TURNS)
        rows.append((f"Jacobian, {len(FREE)} parameters, {name} / outputs", times, "<= 15"))

    evaluations = VEHICLES * (N - 1) * SUBSTEPS * 4
    print(f"{N} samples, {SUBSTEPS} steps each, blocks of {BLOCK}, one core, jax {jax.__version__}")
    print(f"{'':72s} {'ours [ms]':>10s} {'other [ms]':>11s} {'ratio':>8s}  target")
    for name, (a, b, ratio), target in rows:
        print(f"{name:72s} {1e3 * a:10.2f} {1e3 * b:11.2f} {ratio:8.4f}  {target}")
    (_, (a, b, _), _), *_ = rows
    each = f"{1e9 * a / evaluations:.0f} ns, in C {1e9 * b / evaluations:.0f} ns"
    print(f"one right-hand side: {each}")
    print(f"{'compilation':72s} {'[s]':>10s} {'':11s} {'':8s}  target")
    for name, value in seconds.items():
        print(f"{name:72s} {value:10.1f} {'':11s} {'':8s}  <= 20")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from script import Size, asked

    TURNS = asked(__doc__, "some minutes", Size("turns", 9, 1, "how often each is timed")).turns
    main()
