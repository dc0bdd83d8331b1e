"""The one residual: fit, identifiability and uncertainty all differentiate this function.

For flight f and output j the residual is (measured - bias - simulated) / sd (output error), or the
whitened innovation of a Kalman filter (filter error); prior rows (value - mean) / sd follow.
"""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.estimation.jacobian_coloring import seeded, spread_out
from heli_jax.identification.estimation.kalman import Innovations, innovations
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns, unpack
from heli_jax.simulation.simulate import Trajectory, simulate

_FLOOR = 1e-3
"""The likelihood's row stays real however far the noise falls; the next round has another level."""


def driven(layout: Layout, data: Data, u: Unknowns, i: int) -> tuple[Any, Any]:
    """Parameters and inputs of the i-th flight at the unknowns: (logged + offset) * gain."""
    flight, offsets = data.flights[i], u.offsets[i]
    params = layout.model.Params(**{**data.base, **u.params, **u.noise, **flight.known})
    inputs = naming.asdict(flight.inputs)
    inputs = {n: v + offsets[n] if n in offsets else v for n, v in inputs.items()}
    inputs = {n: v * u.gains[n] if n in u.gains else v for n, v in inputs.items()}
    return params, layout.model.Inputs(**inputs)


class Run(NamedTuple):
    """A simulated flight."""

    states: Float[Array, "s N"]
    """as the model's State orders them"""
    outputs: Float[Array, "p N"]
    """what the flight measures, as `Layout.outputs` orders it, without bias"""
    ends: Any
    """with windows the State that each leads to at the next one's first sample, (windows,)"""


def predict(layout: Layout, data: Data, u: Unknowns) -> tuple[Run, ...]:
    """The simulated flights (without bias).

    Windows of one length are simulated together, whichever flight they belong to.
    """
    alone, groups = {}, {}
    for i, flight in enumerate(data.flights):
        key = (layout.windows[i][1], tuple(flight.known), layout.holds[i])
        groups.setdefault(key, []).append(i)
    for (m, *_), members in groups.items():
        if len(members) == 1 and layout.windows[members[0]][0] == 1:
            i = members[0]
            params, inputs = driven(layout, data, u, i)
            dt, state = data.flights[i].dt, u.states[i]
            run = _simulated_one(layout, i, params, inputs, dt, state, u.shift)
            measured = [getattr(run.outputs, n) for n in layout.outputs[i]]
            alone[i] = Run(jnp.stack(jax.tree.leaves(run.states)), jnp.stack(measured), None)
        else:
            alone |= _together(layout, data, u, members, m)
    return tuple(alone[i] for i in range(len(data.flights)))


def _simulated_one(
    layout: Layout, i: int, params: Any, inputs: Any, dt: Any, state: Any, shift: Any
) -> Trajectory:
    """A run with inputs that move between samples as those of the i-th flight."""
    return simulate(
        layout.model,
        params,
        inputs,
        dt=dt,
        initial_state=state,
        solver=layout.solver,
        substeps=layout.substeps,
        delay=shift,
        block=layout.block,
        adjoint=dfx.ForwardMode(),
        hold=layout.hold(i),
    )


def _together(
    layout: Layout, data: Data, u: Unknowns, members: list[int], m: int
) -> dict[int, Run]:
    """The runs of several windows of m samples, by vmap."""
    chained = any(layout.windows[i][0] > 1 for i in members)
    each = []
    for i in members:
        flight, count = data.flights[i], layout.windows[i][0]
        _, inputs = driven(layout, data, u, i)
        n = jax.tree.leaves(inputs)[0].shape[0]
        # With several windows one sample more, at which the next begins.
        at = np.minimum(m * np.arange(count)[:, None] + np.arange(m + chained)[None, :], n - 1)
        state = u.states[i]
        if state is not None:
            state = jax.tree.map(lambda v, c=count: jnp.broadcast_to(v, (c,)), state)
        known = {k: jnp.broadcast_to(v, (count,)) for k, v in flight.known.items()}
        cut = jax.tree.map(lambda v, at=at: v[at], inputs)
        each.append((cut, known, jnp.broadcast_to(flight.dt, (count,)), state))
    stacked = jax.tree.map(lambda *v: jnp.concatenate(v), *each)

    def one(inputs: Any, known: Any, dt: Any, state: Any) -> Any:
        params = layout.model.Params(**{**data.base, **u.params, **u.noise, **known})
        run = _simulated_one(layout, members[0], params, inputs, dt, state, u.shift)
        return run.states, run.outputs

    states, outputs = jax.vmap(one)(*stacked)
    names = naming.names(layout.model.Outputs)
    # All of them in one array, since XLA makes a kernel of every part that is cut out of another.
    x, y = (jnp.stack(jax.tree.leaves(v)) for v in (states, outputs))
    found, first = {}, 0
    for i in members:
        count = layout.windows[i][0]
        n = jax.tree.leaves(data.flights[i].inputs)[0].shape[0]
        mine = slice(first, first + count)

        def joined(v: Array, mine: slice = mine, n: int = n) -> Array:
            return v[:, mine, :m].reshape(v.shape[0], -1)[:, :n]

        ends = jax.tree.map(lambda v, mine=mine: v[mine, -1], states) if count > 1 else None
        rows = np.array([names.index(name) for name in layout.outputs[i]])
        found[i] = Run(joined(x), joined(y[rows]), ends)
        first += count
    return found


def filtered(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> tuple[Innovations, ...]:
    """The innovations of every flight."""
    out = []
    each = zip(data.flights, u.states, u.biases, noise.sd, strict=True)
    for i, (flight, state, bias, sd) in enumerate(each):
        params, inputs = driven(layout, data, u, i)
        out.append(
            innovations(
                layout.model,
                params,
                inputs,
                {n: y - bias[n] for n, y in flight.outputs.items()},
                {n: s * u.scales[n] if n in u.scales else s for n, s in sd.items()},
                dt=flight.dt,
                initial_state=state,
                delay=u.shift,
                substeps=layout.substeps,
                hold=layout.hold(i),
            )
        )
    return tuple(out)


def _signals(layout: Layout) -> list[tuple[int, str]]:
    """What is measured, as (flight, output), in the order of the rows."""
    return [(i, n) for i, names in enumerate(layout.outputs) for n in names]


def _which(layout: Layout, data: Data) -> np.ndarray:
    """Of every measured number its signal."""
    sizes = [data.flights[i].outputs[n].shape[0] for i, n in _signals(layout)]
    return np.repeat(np.arange(len(sizes)), sizes)


def _measured(layout: Layout, data: Data, noise: Noise) -> tuple[Array, Array]:
    """All that is measured, and its sd. Joined: XLA makes kernels of signals one by one."""
    at = _signals(layout)
    sd = jnp.stack([noise.sd[i][n] for i, n in at])
    return jnp.concatenate([data.flights[i].outputs[n] for i, n in at]), sd[_which(layout, data)]


def _likelihood_rows(
    layout: Layout, data: Data, noise: Noise, found: tuple[Innovations, ...]
) -> Array:
    r"""Rows whose sum of squares is minus twice the log-likelihood but for a constant; zero where
    nothing is measured.

    $e_k/\sqrt{s_k}$, and with the common scale of all noise concentrated out each times
    $\exp(\tfrac12(\overline{\log s} - level))$; else one row more, whose square is
    $N(1 + \overline{\log s} - level)$.

    These alone would hold half of what the variances tell ($\tfrac14 s'^2/s^2$ of $\tfrac12$),
    and the optimiser would go twice as far as it should along the noise. As many rows again, zero
    themselves, have the derivative $\tfrac12 (s'_k/s_k - \overline{s'/s})$: with them J'J is
    Fisher's information (Mehra, 1970; Maine and Iliff, 1985, leave that part out). The mean is
    taken off since it is known from elsewhere: with the scale concentrated out it tells nothing,
    else the one row more tells the same of it.
    """
    y, sd = _measured(layout, data, noise)
    at = _signals(layout)
    seen = jnp.isfinite(y)
    s = jnp.where(seen, jnp.concatenate([found[i].variance[n] for i, n in at]), 1.0)
    error = jnp.concatenate([found[i].error[n] for i, n in at])
    rows = jnp.where(seen, error, 0.0) / jnp.sqrt(s)
    log_s = jnp.where(seen, jnp.log(s / sd**2), 0.0)
    count = jnp.sum(seen.astype(rows.dtype))
    mean = jnp.sum(log_s) / count
    above = mean - noise.level
    if layout.concentrated:
        rows, last = rows * jnp.exp(0.5 * above), []
    else:
        last = [jnp.sqrt(count * jnp.maximum(1.0 + above, _FLOOR))[None]]
    log_s = jnp.where(seen, log_s - mean, 0.0)
    return jnp.concatenate([rows, *last, 0.5 * (log_s - jax.lax.stop_gradient(log_s))])


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """(value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Weak priors of initial states, biases, offsets: coordinates are in units of its sd."""
    return z[layout.weak :]


def _simulation_rows(
    layout: Layout, data: Data, noise: Noise, u: Unknowns, runs: tuple[Run, ...]
) -> Array:
    """(measured - bias - simulated) / sd, signal after signal; zero where nothing is measured."""
    y, sd = _measured(layout, data, noise)
    simulated = jnp.concatenate([run.outputs.reshape(-1) for run in runs])
    error = y - _joined(u)[_which(layout, data)] - simulated
    return jnp.where(jnp.isfinite(y), error, 0.0) / sd


def _joined(u: Unknowns) -> Array:
    """The biases, flight after flight and output after output."""
    return jnp.stack([b for bias in u.biases for b in bias.values()])


def _rows(layout: Layout, data: Data, z: Array, *measured: Array | None) -> Array:
    """All rows: those of the measurements, then the priors'."""
    rows = [r for r in measured if r is not None]
    return jnp.concatenate([*rows, prior_rows(layout, data, z), weak_rows(layout, z)])


def _simulated_rows(
    layout: Layout, data: Data, noise: Noise, z: Array, u: Unknowns, runs: tuple[Run, ...]
) -> Array:
    """All rows of output error; with windows also what the states jump between them."""
    measured = _simulation_rows(layout, data, noise, u, runs)
    return _rows(layout, data, z, measured, _jumps(layout, data, u, runs))


def _jumps(layout: Layout, data: Data, u: Unknowns, runs: tuple[Run, ...]) -> Array | None:
    """The jumps of the states between windows over their sd, window by window; None without."""
    rows = []
    for flight, run, begun in zip(data.flights, runs, u.states, strict=True):
        if layout.continuity is None or run.ends is None:
            continue
        # The scale is ten times what the state does.
        jumps = [
            (getattr(run.ends, n)[:-1] - getattr(begun, n)[1:])
            / (0.1 * layout.continuity * flight.state_scale[n])
            for n in layout.states
        ]
        rows.append(jnp.stack(jumps, axis=1).reshape(-1))
    return jnp.concatenate(rows) if rows else None


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """The rows whose squares are summed, without their derivative."""
    u = unpack(layout, data, z)
    if layout.filtered:
        found = filtered(layout, data, noise, u)
        return _rows(layout, data, z, _likelihood_rows(layout, data, noise, found))
    return _simulated_rows(layout, data, noise, z, u, predict(layout, data, u))


class Shown(NamedTuple):
    """What is simulated."""

    outputs: tuple[Float[Array, "p N"], ...]
    """by flight, SI, as `Layout.outputs` orders them, without the bias"""
    biases: Float[Array, " s"]
    """flight after flight and output after output"""
    state_rms: Float[Array, "f n"]
    """root mean square of each simulated state, by flight"""


class Slopes(NamedTuple):
    """Residuals and their derivative at one point."""

    r: Any
    """(n,) whitened residuals with prior rows"""
    J: Any
    """(n, q) derivative of r by z"""
    innovations: tuple[Innovations, ...]
    """by flight; none with output error"""
    shown: Shown | None
    """what output error simulates on its way"""


@eqx.filter_jit
def differentiate(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Slopes:
    """Residuals and their Jacobian in forward mode, in one pass.

    The residual: measured - bias - simulated over sd for all flights and outputs (output error),
    or the whitened innovations (filter error), then the priors' rows (value - mean) / sd, then
    the weak priors' rows.
    """

    def rows(z: Array) -> tuple[Array, Any]:
        u = unpack(layout, data, z)
        if layout.filtered:
            found = filtered(layout, data, noise, u)
            r = _rows(layout, data, z, _likelihood_rows(layout, data, noise, found))
            return r, (r, None, found)
        runs = predict(layout, data, u)
        r = _simulated_rows(layout, data, noise, z, u, runs)
        return r, (r, runs, ())

    seeds = seeded(layout)
    if seeds is None:
        J, (r, runs, found) = jax.jacfwd(rows, has_aux=True)(z)
    else:

        def along(v: Array) -> Any:
            return jax.jvp(rows, (z,), (v,), has_aux=True)

        directions = jnp.asarray(seeds.T, z.dtype)
        r, J, (_, runs, found) = jax.vmap(along, out_axes=(None, -1, None))(directions)
        J = spread_out(layout, data, J)
    shown = None if runs is None else shown_of(unpack(layout, data, z), runs)
    return Slopes(r, J, found, shown)


def shown_of(u: Unknowns, runs: tuple[Run, ...]) -> Shown:
    """Of the simulated flights what is shown."""
    rms = [jnp.sqrt(jnp.mean(jnp.square(run.states), axis=1)) for run in runs]
    return Shown(tuple(run.outputs for run in runs), _joined(u), jnp.stack(rms))
