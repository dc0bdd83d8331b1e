"""Estimates with intervals from the Fourier sums of a stream, by maximum likelihood in frequency.

Each completed block is a record of `identification/estimation/frequency_error.py`: optimiser,
spectrum of the noise and ends are those of frequency error. A call begins at the estimates of the
call before, and takes milliseconds.
"""

import dataclasses
import functools
import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.design.information import covariance
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import named
from heli_jax.identification.estimation.frequency_error import (
    FrequencyError,
    NoiseErrors,
    products_of_record,
    rows_of_products,
)
from heli_jax.identification.estimation.frequency_lines import (
    Matrices,
    Record,
    Sources,
    at_each_line,
    ends_of,
    modelled,
    shared_of,
)
from heli_jax.identification.estimation.frequency_noise import inverse_roots, smoothed
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import relax_noise_covariance
from heli_jax.identification.estimation.residual import Residuals, residual_and_jacobian
from heli_jax.identification.identifiability.analysis import relative_slopes, unknowns_of
from heli_jax.identification.identifiability.verdict import Z95, exponents
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Unknowns,
    layout_of,
    unpack,
)
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.discretize import discretize
from heli_jax.simulation.hold import delays_of
from heli_jax.stream.steps import LINES, Blocks, State, blocks_of


class Estimated(NamedTuple):
    """One estimate, in the unit of its parameter; a combination in SI."""

    value: float
    sd: float
    lower95: float
    upper95: float


class Known(NamedTuple):
    """Estimates of the blocks so far."""

    estimates: dict[str, Estimated]
    """Free parameters, gains and shift."""
    relative: Float[np.ndarray, "q q"]
    """Covariance relative to the values."""
    z: Float[np.ndarray, " q"]
    """Coordinates of the estimates, where the next call begins."""
    noise: Noise
    coherence: dict[tuple[str, str], float]
    """By input and output: part of the output's power that follows the input."""
    blocks: int
    """Blocks completed so far."""

    def of(self, name: str) -> Estimated | None:
        """Return the estimate of a parameter, or of a product such as `a/If`; None if there is
        none."""
        if name in self.estimates:
            return self.estimates[name]
        try:
            powers = exponents(name, tuple(self.estimates))
        except ValueError:
            return None
        return self._product(powers)

    def _product(self, powers: np.ndarray) -> Estimated:
        values = np.array([one.value for one in self.estimates.values()])
        with np.errstate(divide="ignore", invalid="ignore"):
            value = float(np.prod(values**powers))
        sd = float(np.sqrt(max(powers @ self.relative @ powers, 0.0)))
        factor = float(np.exp(min(Z95 * sd, 700.0)))
        return Estimated(value, abs(value) * sd, *sorted((value / factor, value * factor)))

    def sd_of(self, name: str) -> float:
        """Return the sd of an estimate over its value; infinite without one."""
        one = self.of(name)
        return one.sd / abs(one.value) if one is not None and one.value else np.inf

    def combinations(self) -> dict[str, Estimated]:
        """Return the products and quotients that are determined far better than their factors."""
        made, own = {}, np.sqrt(np.diag(self.relative))
        unit = np.eye(len(own))
        for (i, a), (j, b) in itertools.combinations(enumerate(self.estimates), 2):
            for name, sign in ((f"{b}/{a}", -1.0), (f"{a}*{b}", 1.0)):
                one = self._product(unit[j] + sign * unit[i])
                if one.sd < _BETTER * min(own[i], own[j]) * abs(one.value):
                    made[name] = one
        return made


_BETTER = 0.5
"""Relative sd of a product or quotient, over the smaller of its factors', up to which it is
listed."""


# Frequency error on the sums of blocks. A layout has one flight, with all blocks as its records.
# Its inputs are `Signal`s, and its outputs transforms (K, F).


class Signal(NamedTuple):
    """Transforms of an input, and its samples at the ends of the blocks."""

    lines: Complex[Array | np.ndarray, "K F"]
    ends: Float[Array | np.ndarray, "r F"]
    """Samples about the first one of each block, less those about the next one's, over sqrt(N)."""


class _Block(Record):
    """The lines of a block, at most `LINES`."""

    @property
    def lines(self) -> int:
        return min((self.samples - 1) // 2, LINES)


class BlockFacts(NamedTuple):
    """Facts of the blocks that are fixed before tracing."""

    record: _Block
    ahead: int
    """As in `State`."""


class BlockError(FrequencyError):
    """Frequency error on the Fourier sums of blocks."""

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Return a row for each unknown of interest, and one for the rest of the errors."""
        v, unknowns = shared_of(u)

        def model(v: Array, by_instrument: bool) -> tuple[Matrices, Sources]:
            return _model(layout, data, unknowns(v))

        record, W = layout.flight_facts[0].record, noise.whitening[0]
        products = products_of_record(model, v, record, W, _outputs(data))
        return Residuals(rows_of_products(products, v), None)

    def noise_errors(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> NoiseErrors:
        """Return the errors of the completed blocks."""
        errors, vehicle, lost = jax.device_get(_errors(layout, data, noise, z))
        errors = [e for e in np.moveaxis(errors, 2, 0) if np.any(e)]
        # The ends take most of the power at the lowest lines, where gusts are.
        left = len(errors) * errors[0].shape[1] * np.sum(2.0 * (1.0 - lost))
        power = (1.0 - np.minimum(lost, _MOST_LOST)) * max(1.0 - z.size / left, 0.1)
        errors = [e / np.sqrt(power)[:, None] for e in errors]
        samples = layout.flight_facts[0].record.samples
        return NoiseErrors(errors, [0] * len(errors), vehicle, samples)

    def finish(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> Float[Array, " q"]:
        """Return z: blocks have no unknowns of their own."""
        return z


_MOST_LOST = 0.8
"""Largest part of a line's power that counts as taken by the ends."""


def _outputs(data: Data) -> Complex[Array, "K p F"]:
    return jnp.stack([jnp.asarray(y) for y in data.flights[0].outputs.values()], axis=1)


@jitted
def _errors(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> tuple[Complex[Array, "K p F"], Matrices, Float[Array, " K"]]:
    """Return the errors without the effects of the ends, the model, and the part of the errors'
    power that these effects take."""
    record, y = layout.flight_facts[0].record, _outputs(data)
    m, at = _model(layout, data, unpack(layout, data, z))
    ends = ends_of(m, record, noise.whitening[0], at, y)
    made = at_each_line(partial(modelled, m), ends.R, at._replace(ends=ends.inputs))
    lost = jnp.mean(jnp.sum(ends.Q**2, axis=1).reshape(record.lines, -1), axis=1)
    return y - made, m, lost


def _model(layout: Layout, data: Data, u: Unknowns) -> tuple[Matrices, Sources]:
    """Return the discretised model, and the transforms of what drives it."""
    block, ahead = layout.flight_facts[0]
    flight, linear = data.flights[0], tuple(hold == "linear" for hold in layout.holds[0])
    linear = linear if any(linear) else ()
    params = layout.model.Params(**{**data.base, **u.params, **flight.known})
    delays = delays_of(layout.model, params, u.shift, flight.dt)
    Ad, *taps = discretize(layout.model, params, flight.dt, delays, linear)
    _, _, C, D = jacobians(layout.model, params)
    names = naming.names(layout.model.Inputs)
    whole, rest = ([0] * len(names) for _ in range(2))
    if delays is not None:
        of = [delays.group(i) for i in range(len(names))]
        whole = [0 if g is None else delays.whole[g] for g in of]
        rest = [0.0 if g is None else delays.rest[g] for g in of]
    signals = list[Signal](naming.asdict(flight.inputs).values())
    omega, kind = jnp.asarray(np.angle(block.z)), signals[0].lines.dtype

    def turned(samples: Array) -> Array:
        angle = omega[:, None] * samples.astype(omega.dtype)
        return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))

    def lagged(more: int) -> Array:
        """Return the transforms of the inputs as they were `more` samples before."""
        columns = []
        for n, v, own in zip(names, signals, whole, strict=True):
            lag, column = own + more, jnp.asarray(v.lines)
            lags = np.arange(v.ends.shape[0]) - ahead
            if not (isinstance(lag, int) and lag == 0):
                # A shifted block begins and ends with other samples.
                sign = jnp.where((lags >= 1) & (lags <= lag), 1.0, 0.0)
                sign = jnp.where((lags <= 0) & (lags > lag), -1.0, sign)
                other = (sign[:, None] * v.ends).astype(kind)
                column = column + turned(jnp.asarray(lags)[None, :]) @ other
                column = turned(-jnp.asarray(lag)[None, None]) * column
            columns.append(column * u.gains[n].astype(kind) if n in u.gains else column)
        return jnp.stack(columns, axis=1)

    now = lagged(0)
    each = [(M, lag) for M, lag in zip(taps, (0, 1, -1), strict=True) if M is not None]
    U = jnp.concatenate([now if lag == 0 else lagged(lag) for _, lag in each], axis=1)
    held = now
    if delays is not None:
        shares = [
            r if linear and linear[i] else jnp.where(jnp.asarray(r) > 0, 1.0, 0.0)
            for i, r in enumerate(rest)
        ]
        share = jnp.stack([jnp.asarray(v, float) for v in shares])[None, :, None]
        share = share.astype(kind)
        held = share * lagged(1) + (1.0 - share) * now
    rows = np.asarray([naming.names(layout.model.Outputs).index(n) for n in layout.outputs[0]])
    B = jnp.concatenate([M for M, _ in each], axis=1)
    return Matrices(Ad, B, C[rows], D[rows]), Sources(U, held)


@functools.lru_cache(maxsize=8)
def _search(problem: Problem, samples: int, ahead: int) -> Search:
    """Return the search of a problem on blocks, with data that lack their signals."""
    # Blocks have no unknowns of single flights.
    bare = problem.nuisance._replace(initial_state=False, bias=False, input_offset=False)
    of_blocks = dataclasses.replace(
        problem,
        method="frequency-error",
        flights=(problem.training[0],),
        nuisance=bare,
        window=None,
        continuity=None,
        fixed_noise=(),
        instrument=(),
    )
    layout = dataclasses.replace(
        layout_of(of_blocks, of_blocks.training),
        objective=_OBJECTIVE,
        flight_facts=(BlockFacts(_Block(0, 0, samples), ahead),),
    )
    return Search(of_blocks, layout, data_of(of_blocks, of_blocks.training), _STEPS)


_OBJECTIVE = BlockError()
_STEPS = 50
"""Most steps of the optimiser for each estimate of the noise's spectrum."""
_FEW = 0.15
"""Widening of the intervals after one block, and the n-th part of it after n blocks: the weights
are estimated from the same blocks. Measured by experiments/stream.py."""
_WEAK = 0.01
"""Row of each unknown, so that a covariance exists: an sd of 100 times its value."""


def estimate(problem: Problem, state: State, before: Known | None = None) -> Known | None:
    """Return what the completed blocks determine; `before` until all outputs move in them.

    Args:
        problem: that of `init`.
        before: result of an earlier call.
    """
    done = blocks_of(state)
    measured = len(problem.training[0].outputs)
    if not np.any(done.lines[:, -measured:], axis=(0, 2)).all():
        return before
    search = _search(problem, state.length, state.ahead)
    search = search._replace(data=_with_blocks(search, done, state.length))
    if before is None:
        z = start_vector(search.layout, search.data, problem)
        noise = _first_noise(search.layout, done)
    else:
        z, noise = before.z, before.noise
    [best] = search.run(noise, np.asarray(z)[None])
    found = relax_noise_covariance(search, noise, best)
    estimates, relative = _accuracy(search, found.noise, found.best.z, done.count)
    return Known(
        estimates,
        relative,
        np.asarray(found.best.z),
        found.noise,
        _coherence(search, done),
        int(state.blocks),
    )


def _with_blocks(search: Search, done: Blocks, samples: int) -> Data:
    """Return the data with the transforms of the blocks as the signals of their flight."""
    model, ends = search.problem.model, done.ends / np.sqrt(samples)
    names = naming.names(model.Inputs)
    inputs = {n: Signal(done.lines[:, i], ends[:, i]) for i, n in enumerate(names)}
    outputs = {n: done.lines[:, len(names) + j] for j, n in enumerate(search.layout.outputs[0])}
    [flight] = search.data.flights
    flight = flight._replace(inputs=model.Inputs(**inputs), outputs=outputs)
    return search.data._replace(flights=(flight,))


def _first_noise(layout: Layout, done: Blocks) -> Noise:
    """Return the spectrum of each signal alone, as if all of it were noise."""
    y = done.lines[:, -len(layout.outputs[0]) :, : done.count]
    S = smoothed(list(np.moveaxis(y, 2, 0)))[0]
    rms = np.sqrt(np.mean(np.abs(y) ** 2, axis=(0, 2)))
    sd = dict(zip(layout.outputs[0], rms, strict=True))
    return Noise((sd,), np.zeros(()), (inverse_roots(S * np.eye(S.shape[1])),))


def _accuracy(
    search: Search, noise: Noise, z: Float[Array, " q"], count: int
) -> tuple[dict[str, Estimated], Float[np.ndarray, "q q"]]:
    """Return the estimates by name, and their covariance relative to the values."""
    layout, data, problem = search.layout, search.data, search.problem
    J = np.array(residual_and_jacobian(layout, data, noise, z).J)
    J[: len(J) - len(layout.free)] /= 1.0 + _FEW / count
    values, slopes = map(np.asarray, named(layout, data, z))
    unknowns = unknowns_of(problem, layout, values)
    scales = relative_slopes(unknowns, slopes)
    C = np.asarray(covariance(jnp.asarray(np.vstack([J * scales, _WEAK * np.eye(z.size)]))))
    sds = np.sqrt(np.diag(C)) * np.abs(scales)
    ends = [np.asarray(named(layout, data, z + side * Z95 * sds)[0]) for side in (-1.0, 1.0)]
    estimates = {
        n: Estimated(float(v), float(abs(s) * sd), *sorted((float(a), float(b))))
        for n, v, s, sd, a, b in zip(layout.of_interest, values, slopes, sds, *ends, strict=True)
    }
    over = scales * slopes / np.where(values == 0, np.inf, values)
    return estimates, C * np.outer(over, over)


_AVERAGES = 12
"""Least lines and blocks in a coherence."""


def _coherence(search: Search, done: Blocks) -> dict[tuple[str, str], float]:
    """Return, by input and output, the part of the output's power that follows the input."""
    # The window of Hann.
    v = done.lines[..., : done.count]
    v = v[1:-1] - 0.5 * (v[2:] + v[:-2])
    first = np.arange(0, len(v), -(-_AVERAGES // done.count))

    def power(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.sum(np.conj(a) * b, axis=-1), first, axis=0)

    made, names = {}, naming.names(search.problem.model.Inputs)
    for i, name in enumerate(names):
        for j, output in enumerate(search.layout.outputs[0], len(names)):
            uu, yy = (np.real(power(v[:, k], v[:, k])) for k in (i, j))
            follows = np.abs(power(v[:, i], v[:, j])) ** 2 / np.where(uu > 0, uu, np.inf)
            made[name, output] = float(np.sum(follows) / max(np.sum(yy), 1e-300))
    return made
