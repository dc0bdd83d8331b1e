"""What a linear model misses of flights in windows, of stable machines and of unstable ones.

Outputs that forget within a window are simulated; of the others the bounded solution goes through
the windows, and what the ends of the records add to it is projected out.

Sources: Golub and Pereyra (1973) and Kaufman (1975) for the projection.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from heli_jax.analysis.windowed import window_transforms
from heli_jax.identification.estimation.bounded_solution import (
    bounded_outputs,
    ends_outputs,
    span,
)
from heli_jax.identification.estimation.linear_machine import machine_of
from heli_jax.identification.estimation.response_weights import ResponseWeights
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns, unpack


def rows_of_responses(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns
) -> Float[Array, " r"]:
    """Whitened errors of all responses, without what the ends of the records may add.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the windows.
        u: the unknowns, in the units of the model.
    """
    still = jax.lax.stop_gradient(u)
    basis = _ends(layout, data, weights, still)
    if basis is None:
        return _whitened(weights, _all_errors(layout, data, weights, u, None))
    Q, solution = span(jnp.stack([_whitened(weights, v) for v in basis], axis=1))
    # Variable projection (Golub and Pereyra; Kaufman): about the ends that suit these unknowns
    # best, whose own effect moves with the unknowns.
    first = _whitened(weights, _all_errors(layout, data, weights, still, None))
    ends = jax.lax.stop_gradient(solution @ (Q.T @ first)).reshape(len(data.flights), -1)
    rows = _whitened(weights, _all_errors(layout, data, weights, u, ends))
    return rows - Q @ (Q.T @ rows)


def _whitened(weights: ResponseWeights, E: Complex[Array, "W k p"]) -> Float[Array, " r"]:
    """What errors in windows make of the responses, in rows of variance 1."""
    w = weights.windows
    Z = jnp.conj(w.Z)
    S = jnp.einsum("wp,wkz,wkp->kpz", w.seen.astype(Z.dtype), Z, E)
    S = S / jnp.sum(w.seen, axis=0).astype(S.dtype)[None, :, None]
    dH = jnp.einsum("pkmz,kpz->kpm", weights.averages.P, S)
    rows = jnp.einsum("kab,kb->ka", weights.whitening, dH.reshape(dH.shape[0], -1))
    # Of a complex normal error each part has half of the variance.
    return 2.0**0.5 * jnp.concatenate([jnp.real(rows).reshape(-1), jnp.imag(rows).reshape(-1)])


@eqx.filter_jit
def errors_in_windows(
    layout: Layout, data: Data, weights: ResponseWeights, z: Array
) -> Complex[Array, "W k p"]:
    """Transforms of measured less modelled outputs; zero where an output is not seen.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        weights: with the windows.
        z: the unknowns.
    """
    u, w = unpack(layout, data, z), weights.windows
    seen = w.seen[:, None, :]
    E = _all_errors(layout, data, weights, u, None)
    E = E * seen.astype(E.dtype)
    basis = _ends(layout, data, weights, u)
    if basis is None:
        return E
    # Of all that is seen in the windows, each output by its noise, and not of the responses alone.
    power = jnp.real(jnp.einsum("kii->ki", weights.density))
    scale = (seen / jnp.sqrt(power)[None]).astype(E.dtype)

    def rows(v: Array) -> Array:
        v = (v * scale).reshape(-1)
        return jnp.concatenate([jnp.real(v), jnp.imag(v)])

    Q, solution = span(jnp.stack([rows(v) for v in basis], axis=1))
    ends = solution @ (Q.T @ rows(E))
    return E - jnp.einsum("e,ewkp->wkp", ends.astype(E.dtype), basis) * seen.astype(E.dtype)


def _all_errors(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns, ends: Array | None
) -> Complex[Array, "W k p"]:
    """Of all flights; `ends` (flights, n) of outputs that do not forget, zero unless given."""
    of_flight = [None] * len(data.flights) if ends is None else ends
    return jnp.concatenate(
        [
            _flight_errors(layout, data, weights, u, i, of_flight[i])
            for i, starts in enumerate(weights.windows.starts)
            if starts
        ]
    )


def _flight_errors(
    layout: Layout,
    data: Data,
    weights: ResponseWeights,
    u: Unknowns,
    i: int,
    ends: Array | None,
) -> Complex[Array, "W k p"]:
    """One flight's, output by output in the order of the windows."""
    w = weights.windows
    states, offsets = weights.begun
    # Numbers, not unknowns: they are found in time, since responses hardly tell them.
    u = u._replace(states=states, offsets=offsets)
    machine, flight = machine_of(layout, data, u, i), data.flights[i]
    names = layout.outputs[i]
    measured = {n: jnp.nan_to_num(flight.outputs[n]) for n in names}
    through = [n for n, sent in zip(w.outputs, weights.simulated, strict=True) if sent]
    rest = [n for n in names if n in w.outputs and n not in through]
    runs = [(through, lambda: machine.simulated(layout.block))]
    runs += [(rest, lambda: bounded_outputs(machine, ends))]
    for outputs, made in runs:
        if any(n in names for n in outputs):
            run = made()
            for n in outputs:
                if n in names:
                    measured[n] = measured[n] - run[names.index(n)]
    absent = jnp.zeros_like(flight.outputs[names[0]])
    y = jnp.stack([measured.get(n, absent) for n in w.outputs])
    E = window_transforms(y, w.starts[i], w.length, w.numbers, w.dt)
    return jnp.moveaxis(E, 0, -1)


def _ends(
    layout: Layout, data: Data, weights: ResponseWeights, u: Unknowns
) -> Complex[Array, "e W k p"] | None:
    """What the ends of each flight add to outputs that do not forget, a state of a flight in
    a row; None where all outputs forget."""
    w, blocks = weights.windows, []
    if all(weights.simulated):
        return None
    counts = [len(starts) for starts in w.starts]
    for i, starts in enumerate(w.starts):
        names = layout.outputs[i]
        effects = ends_outputs(machine_of(layout, data, u, i))
        n, _, N = effects.shape
        rest = [not sent for sent in weights.simulated]
        columns = [
            effects[:, names.index(name)] if name in names and left else jnp.zeros((n, N))
            for name, left in zip(w.outputs, rest, strict=True)
        ]
        if not starts:
            blocks.append(jnp.zeros((n, sum(counts), len(w.numbers), len(w.outputs)), w.Z.dtype))
            continue
        y = jnp.stack(columns, axis=1).reshape(-1, N)
        E = window_transforms(y, starts, w.length, w.numbers, w.dt)
        E = jnp.moveaxis(E.reshape(n, len(w.outputs), len(starts), -1), 1, -1)
        before, after = sum(counts[:i]), sum(counts[i + 1 :])
        blocks.append(jnp.pad(E, ((0, 0), (before, after), (0, 0), (0, 0))))
    return jax.lax.stop_gradient(jnp.concatenate(blocks))
