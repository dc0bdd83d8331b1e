"""Fourier transforms of records, the response of linear models at their lines, and its errors.

At $z = e^{i\\omega dt}$ of a record's Fourier frequencies the model x[k+1] = Ad x[k] + B U[k] has
exactly the states $X = (zI - A_d)^{-1} [B U + z (x_0 - x_N)]$. Linear least squares gives the
effect of the record's ends ($x_0 - x_N$).

Sources: Pintelon and Schoukens (2012), chapters 6 and 10; Golub and Pereyra (1973) and Kaufman
(1975) for the projection.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.operating_point import mean_condition, mean_heading
from heli_jax.analysis.trim import Condition, equilibrium, is_full_nonlinear, trim
from heli_jax.dynamics.jacobians import about, jacobians, linearised
from heli_jax.dynamics.model import Model
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import FEWEST, SHORTEST, spans
from heli_jax.identification.estimation.simulated_flights import Drive, driven
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    FlightData,
    Layout,
    Noise,
    Unknowns,
    unpack,
)
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.hold import between_samples
from heli_jax.simulation.stepping import held_columns

# Records are flights, cut where an output has a missing sample. Each has its own ends.


class FlightFacts(NamedTuple):
    """Facts of a flight that are fixed before tracing."""

    parts: tuple[tuple[int, int], ...]
    """First sample, and the one after the last, of each part that forms a record."""
    dt: float
    """Sample time [s]."""
    condition: Condition | None = None
    """Steady flight at which a full helicopter is linearised."""


class Record(NamedTuple):
    """Part of a flight without missing samples."""

    flight: int
    """Index of the flight."""
    first: int
    last: int
    """Sample after the last one."""

    @property
    def samples(self) -> int:
        """Number of samples N."""
        return self.last - self.first

    @property
    def lines(self) -> int:
        """Number of Fourier frequencies K, without zero and the Nyquist frequency."""
        return (self.samples - 1) // 2

    @property
    def z(self) -> Complex[np.ndarray, " K"]:
        """exp(i omega dt) at these frequencies."""
        return np.exp(2j * np.pi * np.arange(1, self.lines + 1) / self.samples)


def lines_of[A: (np.ndarray, Array)](v: A) -> A:
    """Return the Fourier transform (K, c) of signals (N, c) divided by sqrt(N), without zero and
    the Nyquist frequency."""
    xp = jnp if isinstance(v, jax.Array) else np
    N = len(v)
    # The mean is subtracted, because rounding would spread it to the other lines.
    return (
        xp.fft.rfft(v - v.mean(axis=0, keepdims=True), axis=0)[1 : 1 + (N - 1) // 2]
        / float(N) ** 0.5
    )


def in_time_of[A: (np.ndarray, Array)](lines: A, samples: int) -> A:
    """Return signals (N, *c) of zero mean from lines (K, *c): the inverse of `lines_of`."""
    xp = jnp if isinstance(lines, jax.Array) else np
    absent = [(1, samples // 2 - len(lines)), *((0, 0) for _ in lines.shape[1:])]
    return xp.fft.irfft(xp.pad(lines, absent), samples, axis=0) * float(samples) ** 0.5


def parts_of(flight: Flight) -> tuple[tuple[int, int], ...]:
    """Return first sample, and the one after the last, of each long part with all outputs."""
    seen = spans(flight.outputs.values())
    if seen == [(0, flight.n_samples)]:
        return tuple(seen)
    # As with `gaps: split`, short parts hardly determine their ends.
    least = max(FEWEST, int(np.ceil(SHORTEST / flight.dt)))
    return tuple((a, b) for a, b in seen if b - a >= least)


def records_of(layout: Layout) -> list[Record]:
    """Return all records, flight after flight."""
    return [Record(i, a, b) for i, facts in enumerate(layout.flight_facts) for a, b in facts.parts]


def without_parts(flights: Sequence[Flight]) -> str | None:
    """Return which flight gives no record and the remedy, or None."""
    for flight in flights:
        if parts_of(flight):
            continue
        missing = {n: float(np.mean(~np.isfinite(y))) for n, y in flight.outputs.items()}
        worst = max(missing, key=lambda n: missing[n])
        return (
            f"{flight.name or 'a flight'}: output {worst} lacks {100 * missing[worst]:.2g} % of "
            f"its samples, and no part of at least {SHORTEST:g} s and {FEWEST} samples has all "
            "outputs without a missing one, which a Fourier transform needs; leave that output "
            "out, lower flights[].rate to its own rate, or use output-error or filter-error"
        )
    return None


def other_outputs(flights: Sequence[Flight]) -> str | None:
    """Return which flight lacks an output of others and the remedy, or None."""
    # The noise's spectrum is one matrix over the outputs, so all flights need them.
    common = set.intersection(*(set(f.outputs) for f in flights))
    for flight in flights:
        more = sorted(set(flight.outputs) - common)
        if more:
            return (
                f"{flight.name or 'a flight'}: output {', '.join(more)} is not in every flight, "
                "and frequency-error has one spectrum of noise for all; leave it out "
                "(signals.outputs), or use frequency-response, output-error or filter-error"
            )
    return None


def cut_notes(layout: Layout, data: Data, names: Sequence[str]) -> list[Finding]:
    """Return a note for each flight that was cut."""
    notes = []
    for i, (flight, facts) in enumerate(zip(data.flights, layout.flight_facts, strict=True)):
        n = next(iter(flight.outputs.values())).shape[0]
        used = sum(b - a for a, b in facts.parts)
        if used == n:
            continue
        lacking = [name for name, y in flight.outputs.items() if not np.isfinite(y).all()]
        words = (
            f"{names[i] if len(data.flights) > 1 else 'The flight'} was cut where samples of "
            f"{', '.join(lacking)} are missing: {used * facts.dt:.4g} of {n * facts.dt:.4g} s are "
            f"used, in {len(facts.parts)} separate {'parts' if len(facts.parts) > 1 else 'part'}."
        )
        notes.append(note("frequency.flight-cut", words, *lacking))
    return notes


# Linear models of flights.
#
# A nonlinear model is linearised at the operating point of the flight. For a full helicopter that
# is the trim at the mean speed. For other models it is the equilibrium at the mean inputs, or the
# initial state if there is none. The point depends on the parameters, with the derivative of an
# implicit function.

# Params, State and Inputs are Any, because they are a model's own classes.

_STEADY = 1e-6
"""Largest rates of an equilibrium, relative to those at the initial state."""


def condition_of(model: Model, flight: Flight) -> Condition | None:
    """Return the steady flight at which a full helicopter is linearised; None for other models."""
    if model.linear or not is_full_nonlinear(model):
        return None
    condition = mean_condition(flight.outputs, flight.dt)
    # The heading matters in hover too, because it mixes positions and velocities in ground axes.
    return condition._replace(heading=mean_heading(flight.outputs))


def cannot_linearise(problem: Problem) -> str | None:
    """Return the reason why a flight has no trim to linearise the model at, or None."""
    for flight in problem.training:
        condition = condition_of(problem.model, flight)
        if condition is None:
            continue
        try:
            trim(problem.model, problem.start_params(flight.known), condition)
        except ValueError as e:
            return f"the model cannot be linearised for {flight.name or 'a flight'}: {e}"
    return None


def linear_drive(layout: Layout, drive: Drive, condition: Condition | None) -> tuple[Model, Drive]:
    """Return a linear model of a flight, and its inputs and parameters.

    Args:
        condition: result of `condition_of`.
    """
    model = layout.model
    if model.linear:
        return model, drive
    if condition is None:
        inputs = jax.tree.map(jnp.mean, drive.inputs)
        state = _equilibrium_at(model, drive.params, inputs)
    else:
        steady = equilibrium(model, drive.params, condition)
        state, inputs = steady.state, steady.inputs
    return linearised(model), drive._replace(params=about(model, drive.params, state, inputs))


def _equilibrium_at(model: Model, params: Any, inputs: Any) -> Any:
    """Return the equilibrium State for constant inputs, or the initial state if there is none."""
    start = naming.ravel(model.initial_state(params), jnp.result_type(float))

    def rates(x: Array, arguments: Any) -> Array:
        p, u = arguments
        return naming.ravel(model.vector_field(p, naming.unravel(model.State, x), u), x.dtype)

    still = jax.lax.stop_gradient((params, inputs))
    # The search is damped, so that states without an equilibrium, like a heading, keep their start.
    solution = optx.root_find(
        rates,
        optx.LevenbergMarquardt(1e-12, 1e-12),
        jax.lax.stop_gradient(start),
        args=still,
        max_steps=100,
        throw=False,
    )
    x = jax.lax.stop_gradient(solution.value)
    size = 1.0 + jnp.max(jnp.abs(rates(start, still)))
    rest = jnp.max(jnp.abs(rates(x, still))) <= _STEADY * size
    inverse = jax.lax.stop_gradient(jnp.linalg.pinv(jax.jacfwd(rates)(x, still)))
    # One more Newton step has the derivative of the root by the parameters.
    x = x - inverse @ rates(x, (params, inputs))
    return naming.unravel(model.State, jnp.where(rest, x, start))


# Discretised models of groups of flights with equal layouts.


class Matrices(NamedTuple):
    """x[k+1] = Ad x[k] + B U[k], y[k] = C x[k] + D held[k]; n states, p measured outputs."""

    Ad: Float[Array, "n n"]
    B: Float[Array, "n r"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]


class Driving(NamedTuple):
    """Inputs of a discretised model."""

    U: Float[Array, "N r"]
    """Inputs of the states, multiplied by B."""
    held: Float[Array, "N m"]
    """Inputs at the samples, multiplied by D."""


def alike(layout: Layout, data: Data) -> list[list[int]]:
    """Return groups of flights that share one model and differ only in their signals."""
    groups: dict[Any, list[int]] = {}
    for i, flight in enumerate(data.flights):
        n = next(iter(flight.outputs.values())).shape[0]
        key = (n, layout.outputs[i], layout.holds[i], layout.flight_facts[i : i + 1])
        # A flight's own offset changes its point of linearisation.
        own = bool(flight.known) or not layout.model.linear
        groups.setdefault((i, *key) if own else key, []).append(i)
    return list(groups.values())


def discretised(
    layout: Layout, data: Data, u: Unknowns, members: Sequence[int], *, by_instrument: bool = False
) -> tuple[Matrices, Driving]:
    """Return the model of a group of flights, and its inputs with a leading axis of flights.

    Args:
        by_instrument: take the part of the inputs that follows the instruments.
    """
    first = members[0]

    def of_one(own: tuple[FlightData, Any, Any]) -> tuple[Matrices, Driving]:
        flight, state, offset = own
        # With one sample time, everything independent of the signals is computed once. The point of
        # linearisation depends only on means, which inputs by instrument share.
        flight = flight._replace(
            dt=data.flights[first].dt,
            inputs=flight.by_instrument if by_instrument else flight.inputs,
        )
        numbers = data._replace(flights=_with(data.flights, first, flight))
        here = u._replace(
            states=_with(u.states, first, state), offsets=_with(u.offsets, first, offset)
        )
        condition = layout.flight_facts[first].condition if layout.flight_facts else None
        model, drive = linear_drive(layout, driven(layout, numbers, here, first), condition)
        model, inputs, linear = between_samples(
            model, drive.inputs, drive.inputs, layout.hold(first)
        )
        Ad, B, U, acting = held_columns(model, drive.params, inputs, drive.dt, u.shift, linear)
        _, _, C, D = jacobians(model, drive.params)
        rows = np.asarray([naming.names(model.Outputs).index(n) for n in layout.outputs[first]])
        return Matrices(Ad, B, C[rows], D[rows]), Driving(U, acting)

    own = [(data.flights[i], u.states[i], u.offsets[i]) for i in members]
    if len(members) == 1:
        # A model that depends on a flight's values would gain an axis in vmap.
        m, driving = of_one(own[0])
        return m, jax.tree.map(lambda v: v[None], driving)
    axes: Any = (None, 0)
    return jax.vmap(of_one, out_axes=axes)(jax.tree.map(lambda *v: jnp.stack(v), *own))


def _with(values: tuple[Any, ...], i: int, value: Any) -> tuple[Any, ...]:
    return (*values[:i], value, *values[i + 1 :])


def shared_of(u: Unknowns) -> tuple[Float[Array, " q"], Callable[[Array], Unknowns]]:
    """Return the unknowns that all flights share (parameters, gains, time shift), and a function
    that returns all unknowns with others in their place."""
    rest = jax.lax.stop_gradient(u)
    v, restored = ravel_pytree((u.params, u.gains, u.shift))

    def unknowns(v: Array) -> Unknowns:
        params, gains, shift = restored(v)
        return rest._replace(params=params, gains=gains, shift=shift)

    return v, unknowns


# The model at the lines of a record.


def at_lines(m: Matrices, record: Record) -> tuple[Complex[Array, " K"], Complex[Array, "K n n"]]:
    """Return z of a record's lines and (zI - Ad)^-1 there, without a derivative."""
    Ad = jax.lax.stop_gradient(m.Ad)
    z = jnp.asarray(record.z, np.result_type(Ad.dtype, np.complex64))
    unit = jnp.eye(len(Ad), dtype=z.dtype)[None]
    return z, jnp.linalg.inv(z[:, None, None] * unit - Ad[None].astype(z.dtype))


_LINES = 32
"""Lines that are evaluated together, so that their sensitivities stay in the processor's cache."""


class Sources(NamedTuple):
    """Transforms of what drives one record of each flight of a group."""

    U: Complex[Array, "K r f"]
    """Inputs of the states, multiplied by B."""
    held: Complex[Array, "K m f"]
    """Inputs at the samples, multiplied by D."""
    ends: Complex[Array, "K n f"] | None = None
    """Inputs of the states by the ends of the record; default zero."""


def lines_of_flights(record: Record, v: Float[Array, "f N c"]) -> Complex[Array, "K c f"]:
    """Return the transforms of one record of each flight of a group."""
    # Signals are delayed before they are cut, because an input may be logged before it acts.
    return lines_of(jnp.moveaxis(v[:, record.first : record.last], 0, -1))


def sources(record: Record, driving: Driving) -> Sources:
    """Return the transforms of inputs over whole flights, without the effects of the ends."""
    return Sources(*(lines_of_flights(record, v) for v in driving))


def at_each_line(of_line: Callable[..., Array], *lines: Any) -> Array:
    """Evaluate a function at each line; the leading axes of `lines` are the lines."""
    return jax.lax.map(lambda line: of_line(*line), lines, batch_size=_LINES)


def modelled(m: Matrices, R: Complex[Array, "n n"], at: Sources) -> Complex[Array, "p f"]:
    """Return the outputs at one line.

    Args:
        R: (zI - Ad)^-1.
        at: sources at this line.
    """
    Ad, B, C, D = (v.astype(R.dtype) for v in m)
    inputs = B @ at.U if at.ends is None else B @ at.U + at.ends
    # Products replace the derivative of an inverse: dY = C R (dAd X + dU) + dC X. The differences
    # are zero, but their derivatives are not.
    X = jax.lax.stop_gradient(R @ inputs)
    dA, dC = (v - jax.lax.stop_gradient(v) for v in (Ad, C))
    return (jax.lax.stop_gradient(C) @ R) @ (inputs + dA @ X) + dC @ X + D @ at.held


def real_rows(v: Complex[Array, "K p *c"]) -> Float[Array, "r *c"]:
    """Return real and imaginary parts of whitened errors as rows of variance 1, line by line."""
    # The real part of a complex normal error has half of its variance.
    rows = 2.0**0.5 * jnp.concatenate([jnp.real(v), jnp.imag(v)], axis=1)
    return rows.reshape(-1, *v.shape[2:])


_NO_END = 1e-10
"""Effect of a state, relative to the largest one, below which it has none."""
_ROUNDING = 100.0
"""Power of a direction, relative to the largest one, below which it is rounding, as a multiple of
the floating-point precision."""
_SPARED = 0.1
"""Largest fraction of a record's degrees of freedom for its ends and those of gusts."""


def orthonormal(gram: Float[Array, "m m"], least: float = 0.0) -> Float[Array, "m m"]:
    """Return S with S^T G S the identity, but zero for directions without effect.

    Args:
        gram: products G of columns; the columns times S are orthonormal.
        least: size of a column, relative to the largest one, below which it has no effect.
    """
    sizes = jnp.sqrt(jnp.maximum(jnp.diagonal(gram), 0.0))
    seen = sizes > least * jnp.max(sizes)
    # Columns are normalised to be independent of units.
    over = jnp.where(seen, 1.0 / jnp.where(seen, sizes, 1.0), 0.0)
    values, vectors = jnp.linalg.eigh(gram * over[:, None] * over[None, :])
    kept = values > _ROUNDING * jnp.finfo(values.dtype).eps * values[-1]
    root = jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, values, 1.0)), 0.0)
    return over[:, None] * vectors * root[None, :]


def projection(basis: Float[Array, "r m"]) -> tuple[Float[Array, "r m"], Float[Array, "m m"]]:
    """Return orthonormal effects Q of a record's ends, and S with Q the basis times S.

    Columns of ends without effect are zero.
    """
    # The column of a state without effect on the outputs is rounding, and its direction changes at
    # each step. Projecting it out would make the sum of squares rough.
    least = max(_NO_END, 10.0 * float(jnp.finfo(basis.dtype).eps))
    S = orthonormal(basis.T @ basis, least)
    return basis @ S, S


class Ends(NamedTuple):
    """Effects of the ends of one record of each flight of a group, and their least squares."""

    R: Complex[Array, "K n n"]
    """(zI - Ad)^-1 at the lines."""
    Q: Float[Array, "r m"]
    """Orthonormal effects on the whitened errors."""
    inputs: Complex[Array, "K n f"]
    """Inputs of the states by the ends."""
    errors: Float[Array, "r f"]
    """Whitened errors without these effects."""


def ends_of(
    m: Matrices,
    record: Record,
    whitening: Complex[Array, "K p p"],
    at: Sources,
    outputs: Complex[Array, "K p f"],
) -> Ends:
    """Fit the ends of one record of each flight by linear least squares.

    Args:
        outputs: transforms of the measured outputs.
    """
    z, R = at_lines(m, record)
    # A gust that does not end where it began has a jump, which affects all lines. Treated as
    # independent noise of each line, it would shift slow modes by several standard deviations.
    # Above its corner frequency it is an integrated push; dividing by the length keeps it
    # comparable to the states' ends.
    effects = jnp.stack([z, z / (z - 1.0) / record.samples], axis=1)
    (p, n), K = m.C.shape, record.lines
    if 2 * n > _SPARED * 2 * p * K:
        effects = effects[:, :1]
    H = whitening.astype(z.dtype) @ m.C[None].astype(z.dtype) @ R
    made = H[:, :, None, :] * effects[:, None, :, None]
    Q, S = projection(real_rows(made.reshape(K, p, -1)))
    errors = errors_of_record(m, whitening, R, at, outputs)
    along = Q.T @ errors
    factors = (S @ along).reshape(effects.shape[1], n, -1).astype(z.dtype)
    return Ends(R, Q, jnp.einsum("ke,enf->knf", effects, factors), errors - Q @ along)


def errors_of_record(
    m: Matrices,
    whitening: Complex[Array, "K p p"],
    R: Complex[Array, "K n n"],
    at: Sources,
    outputs: Complex[Array, "K p f"],
) -> Float[Array, "r f"]:
    """Return measured less modelled outputs of one record of each flight in rows of variance 1."""

    def errors(W: Array, R: Array, at: Sources, outputs: Array) -> Float[Array, "1 2p f"]:
        return real_rows((W.astype(R.dtype) @ (outputs - modelled(m, R, at)))[None])

    rows = at_each_line(errors, whitening, R, at, outputs)
    return rows.reshape(-1, rows.shape[-1])


def records_of_group(
    layout: Layout, noise: Noise, members: list[int]
) -> list[tuple[Record, Complex[Array, "K p p"]]]:
    """Return the records of each flight of a group, with their whitening."""
    # Records of equal length share one spectrum (`smoothed`), that of the first flight.
    pairs = zip(records_of(layout), noise.whitening, strict=True)
    return [(record, W) for record, W in pairs if record.flight == members[0]]


def measured(layout: Layout, data: Data, members: list[int]) -> Float[Array, "f N p"]:
    """Return the measured outputs of a group's flights."""
    names = layout.outputs[members[0]]
    columns = [[data.flights[i].outputs[n] for n in names] for i in members]
    return jnp.stack([jnp.stack([jnp.asarray(v) for v in of], axis=1) for of in columns])


class LineErrors(NamedTuple):
    """Errors of all records."""

    errors: list[Complex[Array, "K p"]]
    """Errors by record, without the effects of its ends, not whitened."""
    model: Matrices
    """Model of the first flight."""


@jitted
def errors_of_lines(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> LineErrors:
    """Return the errors at the lines of every record."""
    u, errors, first = unpack(layout, data, z), dict[tuple[int, int], Array](), None
    for members in alike(layout, data):
        m, driving = discretised(layout, data, u, members)
        first = m if first is None else first
        y = measured(layout, data, members)
        for k, (record, W) in enumerate(records_of_group(layout, noise, members)):
            here, of_outputs = sources(record, driving), lines_of_flights(record, y)
            ends = ends_of(m, record, W, here, of_outputs)
            here = here._replace(ends=ends.inputs)
            made = of_outputs - at_each_line(partial(modelled, m), ends.R, here)
            errors |= {(i, k): made[:, :, j] for j, i in enumerate(members)}
    assert first is not None
    return LineErrors([errors[at] for at in sorted(errors)], first)
