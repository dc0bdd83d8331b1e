"""Levenberg-Marquardt from many starts near an optimum, or on many records, side by side."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import stages
from heli_jax.fused.code import UnsupportedError, translating
from heli_jax.fused.kernel import Kernel, lanes_for
from heli_jax.fused.sensitivities import Products, Sensitive, full
from heli_jax.fused.traced import Traced, traced
from heli_jax.identification.estimation.levenberg_marquardt import (
    BATCHED,
    Constants,
    Optimum,
    descend,
    scaling,
    ties_of,
    trusted_columns,
)
from heli_jax.identification.estimation.output_error import OutputError
from heli_jax.identification.estimation.residual import prior_rows, residual_and_jacobian, weak_rows
from heli_jax.identification.estimation.simulated_flights import driven, measured_counts
from heli_jax.identification.unknowns.layout import (
    Data,
    FlightData,
    Layout,
    Noise,
    Solution,
    flight_places,
    unpack,
)
from heli_jax.numerics.cores import cores
from heli_jax.simulation.accumulate import Steps, in_steps
from heli_jax.simulation.options import SimulationOptions

# Residuals and Jacobians of many runs as programs of machine code, a vehicle beside the other.
#
# What least squares asks of a record is the sums of products of its rows and columns; with these
# made on the way nothing of the flight is kept but its last state.


_MOST = 6000
"""operations of a sample, derivatives included: more would take longer to compile than to run"""

# `Any` below: the functions that JAX compiles, and trees of arrays.


class Own(NamedTuple):
    """The parts of the record that each run has of its own."""

    inputs: bool
    outputs: bool
    """as measured"""


class _Part(NamedTuple):
    """One flight's program."""

    kernel: Kernel
    run: Traced
    begin: Any
    """of (what is shared, records, unknowns (b, q)): what a run begins with, `Traced.own`"""
    common: Any
    """of the same for one run: what stays and is the same for all"""
    places: np.ndarray
    """where its columns stand among [r J]"""


class FusedRuns:
    """Residuals and Jacobians of a problem at many points, or of many records."""

    def __init__(self, layout: Layout, data: Data, noise: Noise, own: Own) -> None:
        """Translate and compile, or take what was compiled for the same.

        Raises:
            UnsupportedError: this has no such program.
        """
        if reason := _refused(layout):
            raise UnsupportedError(reason)
        self._layout, self._shared = layout, (_bare(data), noise.sd)
        self._records = [(f.inputs, f.outputs) for f in data.flights]
        self._own = own
        leaves, structure = jax.tree.flatten((data, noise.sd))
        kinds = tuple((np.shape(v), np.asarray(v).dtype) for v in leaves)
        self._parts = _compiled(layout, structure, kinds, own)

    def __call__(self, data: Data, z: Array) -> tuple[Array, Array]:
        """Rows (b, n) and Jacobians (b, n, q) at unknowns (b, q): of each run those of a triangle
        that stands for its measurements, then those of the priors. All of `data` has a leading axis
        (b,)."""
        triangle = _triangles(self._sums(data, np.asarray(z)))
        r, J = _priors(self._layout, data, z)
        rows = jnp.concatenate([jnp.asarray(triangle[:, :, 0], z.dtype), r], axis=1)
        return rows, jnp.concatenate([jnp.asarray(triangle[:, :, 1:], z.dtype), J], axis=1)

    def _sums(self, data: Data, z: np.ndarray) -> np.ndarray:
        """(b, q + 1, q + 1) of the measurements' [r J], its transpose times itself."""
        count, q = z.shape
        # Whole vectors of runs: the last one again where there are too few.
        lanes = self._parts[0].kernel.lanes
        filled = np.minimum(np.arange(-(-count // lanes) * lanes), count - 1)
        sums = np.zeros((count, q + 1, q + 1))
        for i, part in enumerate(self._parts):
            flight = data.flights[i]
            records = [
                jax.tree.map(lambda v: np.asarray(v)[filled].T, its) if own else shared
                for own, its, shared in zip(
                    self._own, (flight.inputs, flight.outputs), self._records[i], strict=True
                )
            ]
            of_flight = self._part(part, records, z[filled])
            sums[np.ix_(range(count), part.places, part.places)] += of_flight[:count]
        return sums

    def _part(self, part: _Part, records: Sequence[Any], z: np.ndarray) -> np.ndarray:
        one = tuple(
            jax.tree.map(lambda v: v[:, 0], of) if own else of
            for own, of in zip(self._own, records, strict=True)
        )
        begun = part.begin(self._shared, one, z)
        common = part.common(self._shared, one, z[0])
        triangle = part.run.compute(part.kernel, begun, common, records, cores())
        return full(np.asarray(triangle))


def _refused(layout: Layout) -> str | None:
    """The reason why a problem has no such program; None where it may have one."""
    if type(layout.objective) is not OutputError:
        return "a method other than output error"
    if layout.shift:
        return "a time shift among the unknowns"
    if any(count > 1 for count, _ in layout.windows):
        return "windows"
    return None


def _bare(data: Data) -> Data:
    """The numbers without the records."""
    flights = tuple(
        f._replace(inputs=None, outputs=dict.fromkeys(f.outputs), by_instrument=None)
        for f in data.flights
    )
    return data._replace(flights=flights)


def _with(data: Data, i: int, records: Any, samples: tuple[int, ...]) -> Data:
    """With the records of the i-th flight; of the others the lengths alone."""
    flights = list(data.flights)
    for j, flight in enumerate(flights):
        nothing = np.broadcast_to(np.zeros((), np.float64), samples[j])
        flights[j] = flight._replace(outputs=dict.fromkeys(flight.outputs, nothing))
    inputs, outputs = records
    flights[i] = flights[i]._replace(inputs=inputs, outputs=outputs)
    return data._replace(flights=tuple(flights))


def _making(layout: Layout, i: int, samples: tuple[int, ...]) -> Any:
    """The i-th flight as `fused.traced.Making`."""
    places, names = flight_places(layout)[i], layout.outputs[i]

    def making(shared: Any, records: Any, z: Any) -> Products:
        data, sd = _with(shared[0], i, records, samples), shared[1][i]
        flight: FlightData = data.flights[i]

        def run(z: Any) -> Steps:
            u = unpack(layout, data, z)
            drive = driven(layout, data, u, i)

            def update(_: Any, outputs: Any, measured: Any) -> Any:
                # A missing sample says nothing: its row is zero, and so is its derivative.
                seen = {n: jnp.isfinite(measured[n]) for n in names}
                error = {n: measured[n] - u.biases[i][n] - getattr(outputs, n) for n in names}
                return tuple(
                    (jnp.where(seen[n], error[n], 0.0) / sd[n], seen[n].astype(z.dtype))
                    for n in names
                )

            zero = jnp.zeros((), z.dtype)
            return in_steps(
                layout.model,
                drive.params,
                drive.inputs,
                update,
                tuple((zero, zero) for _ in names),
                data=flight.outputs,
                options=SimulationOptions(
                    dt=drive.dt,
                    initial_state=drive.state,
                    solver=layout.solver,
                    substeps=layout.substeps,
                    hold=layout.hold(i),
                ),
            )

        def rows(value: Any, derivatives: Any) -> Any:
            made = []
            for k, name in enumerate(names):
                r, seen = value[k]
                by_bias = [jnp.zeros_like(r)] * places.biases.size
                if layout.bias:
                    # In the order of the outputs, and felt by no state.
                    by_bias[k] = -flight.bias_scale[name] / sd[name] * seen
                made.append([r, *(d[k][0] for d in derivatives), *by_bias])
            return made

        # What a sample computed stands in the carry, beside the limits that nobody asks for.
        return Products(
            Sensitive(
                run,
                samples[i] - 1,
                [*range(len(layout.of_interest)), *places.offsets.tolist()],
                places.states.ravel().tolist(),
                lambda carry: carry[1][0],
                lambda z, carry: run(z).last(carry).value,
                rows,
            ),
            z,
        )

    return making


@functools.lru_cache(maxsize=16)
@translating()
def _compiled(
    layout: Layout,
    structure: Any,
    kinds: tuple[tuple[tuple[int, ...], np.dtype], ...],
    own: Own,
) -> tuple[_Part, ...]:
    data, sd = jax.tree.unflatten(structure, [np.zeros(*kind) for kind in kinds])
    samples = tuple(next(iter(f.outputs.values())).shape[0] for f in data.flights)
    return tuple(
        _part(layout, i, (_bare(data), sd), data.flights[i], samples, own)
        for i in range(len(data.flights))
    )


def _part(
    layout: Layout,
    i: int,
    shared: Any,
    flight: FlightData,
    samples: tuple[int, ...],
    own: Own,
) -> _Part:
    records = flight.inputs, flight.outputs
    each = [o for o, of in zip(own, records, strict=True) for _ in jax.tree.leaves(of)]
    z = np.zeros(layout.size)
    run = traced(_making(layout, i, samples), shared, records, z, each)
    if (size := _size(run.run.step.jaxpr)) > _MOST:
        raise UnsupportedError(f"a sample of {size} operations, more than {_MOST}")
    its, interest = flight_places(layout)[i], np.arange(len(layout.of_interest))
    order = [interest, its.offsets, its.states.ravel(), its.biases]
    places = np.r_[0, 1 + np.concatenate(order)]
    return _Part(
        Kernel(run.run, lanes_for(np.dtype(np.float64))),
        run,
        jax.jit(jax.vmap(run.own, in_axes=(None, None, 0))),
        jax.jit(run.common),
        places,
    )


def _size(jaxpr: Any) -> int:
    """Operations, those of inner functions too."""
    total = 0
    for equation in jaxpr.eqns:
        inner = [v for v in equation.params.values() if hasattr(v, "jaxpr") or hasattr(v, "eqns")]
        passes = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        total += max(1, passes * sum(_size(getattr(v, "jaxpr", v)) for v in inner))
    return total


def _triangles(sums: np.ndarray) -> np.ndarray:
    """(b, m, m) whose products with themselves, transposed, are the sums (b, m, m).

    Where a sum is not finite all is NaN, as the rows would be.
    """
    usable = np.isfinite(sums).all(axis=(1, 2))
    safe = np.where(usable[:, None, None], sums, np.eye(sums.shape[1]))
    size = np.sqrt(np.diagonal(safe, axis1=1, axis2=2))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(safe / unit[:, :, None] / unit[:, None, :])
    # Rounding leaves directions without effect a little below zero.
    roots = np.sqrt(np.maximum(values, 0.0))
    rows = roots[:, :, None] * np.swapaxes(vectors, 1, 2) * unit[:, None, :]
    return np.where(usable[:, None, None], rows, np.nan)


@functools.partial(jax.jit, static_argnums=0)
def _priors(layout: Layout, data: Data, z: Array) -> tuple[Array, Array]:
    """The rows of the priors, and their Jacobians."""

    def rows(data: Data, z: Array) -> Array:
        return jnp.concatenate([prior_rows(layout, data, z), weak_rows(layout, z)])

    return jax.vmap(rows)(data, z), jax.vmap(jax.jacfwd(rows, argnums=1))(data, z)


_MANY = 24
"""runs from which on a program of machine code is worth its compilation"""
_BATCH = 8
"""records side by side by XLA"""
_SIDE_BY_SIDE = 256
"""runs that such a program computes together: between them somebody may interrupt"""
_MANY_STEPS = 60
"""steps after which a run among many, which began near its optimum, is given up"""


@eqx.filter_jit
def _batch(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, "b q"]
) -> tuple[Float[Array, "b n"], Float[Array, "b n q"]]:
    """Residuals and Jacobians of a batch; all of `data` has a leading axis too."""
    each = jax.vmap(lambda data, z: residual_and_jacobian(layout, data, noise, z)[:2])
    return each(data, z)


def optimise_many(
    reached: Solution,
    data: Callable[[Any], Data],
    k: int,
    each: Any,
    say: Callable[[str], None],
) -> Optimum:
    """Return the optima (k, ...) of many records, each searched from one optimum.

    Args:
        data: makes the numbers of one run out of its slice of `each`.
        each: what differs between the runs, a pytree of arrays (k, ...).
        say: called with a sentence where many runs are no programs of machine code.
    """
    layout, noise = reached.layout, reached.noise
    r, J = residual_and_jacobian(*reached)[:2]

    def at(z: Array) -> tuple[Array, Array]:
        return residual_and_jacobian(layout, reached.data, noise, z)[:2]

    units = scaling(r, J, trusted_columns(layout, at, reached.z, r, J))
    fused = _fused(reached, data, each, say) if k >= _MANY else None
    batch, optima = min(_BATCH if fused is None else _SIDE_BY_SIDE, k), []
    z0 = jnp.tile(reached.z[None, :], (batch, 1))
    one = Constants(reached.z, units, jnp.asarray(ties_of(layout)), jnp.asarray(True))
    constants = jax.tree.map(lambda v: jnp.broadcast_to(v, (batch, *jnp.shape(v))), one)
    for i in range(0, k, batch):
        # The last ones again where the batch is not full: another shape would compile anew.
        chosen = np.minimum(np.arange(i, i + batch), k - 1)
        numbers = jax.vmap(data)(jax.tree.map(lambda v, chosen=chosen: v[chosen], each))

        def evaluate(z: Array, numbers: Data = numbers) -> tuple[Array, Array]:
            return _batch(layout, numbers, noise, z) if fused is None else fused(numbers, z)

        # Each record's own: of one another may lack most samples.
        count = measured_counts(numbers)
        ends = descend(evaluate, constants, evaluate(z0), count, _MANY_STEPS, BATCHED).optimum
        optima.append(jax.tree.map(lambda v, n=min(batch, k - i): np.asarray(v)[:n], ends))
        stages.advance(min(batch, k - i))
    return jax.tree.map(lambda *v: np.concatenate(v), *optima)


def _fused(
    reached: Solution,
    data: Callable[[Any], Data],
    each: Any,
    say: Callable[[str], None],
) -> FusedRuns | None:
    """The runs as programs of machine code; None where they cannot be."""
    layout, numbers, noise, _ = reached
    one = jax.tree.map(lambda v: v[0], each)
    flights = list(zip(data(one).flights, numbers.flights, strict=True))
    # Beside the means of priors.
    own = Own(
        any(made.inputs is not given.inputs for made, given in flights),
        any(made.outputs is not given.outputs for made, given in flights),
    )
    try:
        return FusedRuns(layout, numbers, noise, own)
    except UnsupportedError as e:
        say(
            "each record is fitted by XLA step by step, not by one program of machine code: "
            f"there is no translation of {e}"
        )
        return None
