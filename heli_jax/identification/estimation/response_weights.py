"""What the fit of frequency responses weighs its errors by."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Complex, Float

from heli_jax import naming
from heli_jax.analysis.response_errors import (
    Averages,
    averages,
    covariance,
    noise_density,
    pairs_used,
    partial_coherence,
    response_of,
    whitening,
)
from heli_jax.analysis.response_options import ResponseOptions
from heli_jax.analysis.windowed import Windowed, hann, windowed
from heli_jax.dynamics.jacobians import StateSpace, jacobians
from heli_jax.dynamics.model import zeros
from heli_jax.errors import nearest
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.frequency_noise import (
    corners_of,
    machine_of,
    powers_of,
    shapes_of,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout

_LAGS = 48
"""lags, from a sample to the record's length, at which an impulse response is looked at"""


def forgets(
    matrices: StateSpace, dt: float, sizes: Float[np.ndarray, " m"], length: int, samples: int
) -> Bool[np.ndarray, " p"]:
    """Of each output whether what an input did has decayed to a part of e after a window, and stays
    so over the record: then a simulation of the whole record is sound.

    Args:
        matrices: of the model, with numbers.
        dt: [s].
        sizes: standard deviation of each input.
        length: samples of a window.
        samples: of the record.
    """
    A, B, C = (np.asarray(v, float) for v in matrices[:3])
    if not all(np.isfinite(v).all() for v in (A, B, C)):
        return np.zeros(C.shape[0], bool)
    Ad = scipy.linalg.expm(A * dt)
    lags = np.geomspace(1, max(samples, 2 * length), _LAGS).astype(int)
    lags = np.unique(np.append(lags, length))
    with np.errstate(all="ignore"):
        powers = [np.linalg.matrix_power(Ad, int(t)) for t in lags]
        g = np.array([np.linalg.norm(C @ P @ (B * sizes), axis=1) for P in powers])
        peak = np.max(g[lags <= length], axis=0)
        return np.all(g[lags >= length] <= np.exp(-1.0) * peak, axis=0)


# Numbers of these classes are arrays, NumPy's or JAX's once they are traced: Any or Array.


class ResponseWeights(NamedTuple):
    """Flights in windows, and the whitening of the errors of their responses."""

    windows: Windowed
    averages: Averages
    """with zeros in place of what is not determined"""
    asked: Any
    """(k, p, m) which responses are asked for and coherent enough"""
    coherence: Any
    """(k, p, m) partial"""
    simulated: tuple[bool, ...]
    """by output whether the model is simulated and sent through the windows"""
    used: Any
    """(k, p, m) which take part"""
    density: Any
    """(k, p, p) the noise's spectral matrix, per Hz"""
    whitening: Any
    """(k, r, r), r = p m: rows whose squares count for as much as a line is independent"""
    share: Any
    """(k,) of each line how much of an independent one it is"""
    begun: Any
    """by flight the initial States (None where they are the model's own) and the inputs' offsets by
    name, as they suit the record in time best; zero before these are known"""

    @property
    def log_determinant(self) -> float:
        """Of the whitening of the responses that take part, lines by their share."""
        r = np.arange(self.whitening.shape[1])
        diagonal = np.real(np.asarray(self.whitening)[:, r, r])
        taken = np.asarray(self.used).reshape(diagonal.shape)
        share = np.asarray(self.share)[:, None]
        logs = np.log(np.where(taken, diagonal / np.sqrt(share), 1.0))
        return float(np.sum(share * logs))

    @property
    def numbers(self) -> float:
        """Independent complex ones that take part."""
        return float(np.sum(np.asarray(self.share)[:, None, None] * np.asarray(self.used)))

    @property
    def numbers_of_noise(self) -> float:
        """Independent real ones that the noise's spectrum is taken from."""
        averages = np.maximum(self.windows.averages - len(self.windows.inputs), 1.0)
        seen = np.any(np.asarray(self.used), axis=2)
        return float(np.sum(2.0 * np.asarray(self.share)[:, None] * seen * averages))

    def variance(self) -> np.ndarray:
        """(k, p, m) of the complex error of each response"""
        C = covariance(Averages(*(np.asarray(v) for v in self.averages)), np.asarray(self.density))
        return np.real(np.einsum("kixix->kix", C))


def first_weights(
    problem: Problem, flights: Sequence[Flight], simulated: tuple[bool, ...] | None = None
) -> ResponseWeights:
    """Of what is measured alone: the noise is what no response explains of the outputs.

    Args:
        problem: says which responses.
        flights: those fitted.
        simulated: by output of the model; by the model at its start values unless given.

    Raises:
        ValueError: windows, band or pairs do not fit the flights, or too little is left.
    """
    options = problem.frequency
    _require_names(problem, options)
    w = windowed(flights, options, instruments_of(problem))
    at = averages(w)
    sound = np.isfinite(response_of(w, at, w.Y))
    if len(w.inputs) > 1 and not sound.any():
        raise ValueError(
            f"frequency: {' and '.join(w.inputs)} move as one, so that no response tells what each "
            "of them does; expected inputs that move apart, or one of them"
        )
    coherence = partial_coherence(w, at)
    at = at._replace(P=np.nan_to_num(at.P))
    asked = pairs_used(w, options, coherence, sound)
    _require_lines(w, options, asked)
    forgetful = forgetful_outputs(problem, flights, w) if simulated is None else simulated
    density = noise_density(w, at, w.Y)
    begun = _at_rest(problem, len(flights))
    weights = ResponseWeights(w, at, asked, coherence, forgetful, asked, density, None, None, begun)
    weights = weighed(weights, forgetful, density)
    _require_numbers(problem, weights)
    return weights


def _at_rest(problem: Problem, flights: int) -> tuple[tuple[Any, ...], tuple[dict, ...]]:
    """Initial states and offsets of zero, in the form in which they are found later."""
    # The same form from the beginning: another one would be compiled anew.
    state = zeros(problem.model.State) if problem.nuisance.initial_state else None
    offsets = {n: jnp.zeros(()) for n in problem.offset_inputs}
    return (state,) * flights, (offsets,) * flights


def weighed(
    weights: ResponseWeights, simulated: tuple[bool, ...], density: Complex[np.ndarray, "k p p"]
) -> ResponseWeights:
    """The same with another spectrum of the noise.

    Args:
        weights: so far.
        simulated: by output whether the model goes through the windows.
        density: of the noise.
    """
    w = weights.windows
    # What goes through the same windows as the record may be of their sidelobes: so is the other.
    # A response at one frequency is not told from the window's shape by less than two periods.
    through = np.asarray(simulated, bool)[None, :, None]
    own = np.asarray(w.own) & (w.lines >= 2)[:, None, None]
    used = np.asarray(weights.asked) & (through | own)
    at = Averages(*(np.asarray(v) for v in weights.averages))
    each = np.moveaxis(at.share, 0, 1)
    share = np.sum(each * used, axis=(1, 2)) / np.maximum(np.sum(used, axis=(1, 2)), 1)
    share = np.where(share > 0, share, 1.0)
    W = whitening(at, density, used) * np.sqrt(share)[:, None, None]
    return weights._replace(
        simulated=simulated, used=used, density=density, whitening=W, share=share
    )


def forgetful_outputs(problem: Problem, flights: Sequence[Flight], w: Windowed) -> tuple[bool, ...]:
    """By output in windows whether the model at its start values may be simulated.

    Args:
        problem: model and start values.
        flights: those fitted.
        w: in windows.
    """
    start = problem.start_params()
    parameters = [naming.asdict(naming.replace(start, **f.known)) for f in flights]
    return outputs_that_forget(problem.model, parameters, [f.inputs for f in flights], w)


# model is a Model and parameters are by name: records of any model.
def outputs_that_forget(
    model: Any,
    parameters: Sequence[dict[str, Any]],
    inputs: Sequence[dict[str, np.ndarray]],
    w: Windowed,
) -> tuple[bool, ...]:
    """By output in windows whether the model may be simulated over every flight.

    Args:
        model: linear.
        parameters: by flight, by name, SI.
        inputs: by flight, by name, (N,).
        w: the flights in windows.
    """
    fine = np.ones(len(w.outputs), bool)
    rows = [naming.names(model.Outputs).index(n) for n in w.outputs]
    for values, u in zip(parameters, inputs, strict=True):
        sizes = np.array([np.std(np.asarray(u[n])) for n in naming.names(model.Inputs)])
        matrices = jacobians(model, model.Params(**values))
        samples = len(next(iter(u.values())))
        fine &= forgets(matrices, w.dt, sizes, w.length, samples)[rows]
    return tuple(bool(v) for v in fine)


def _require_names(problem: Problem, options: ResponseOptions) -> None:
    for i, pair in enumerate(options.pairs):
        for role, record in (("input", problem.model.Inputs), ("output", problem.model.Outputs)):
            name, known = getattr(pair, role), naming.names(record)
            if name not in known:
                raise ValueError(
                    f"frequency.pairs[{i}].{role}: model {problem.model.name} has no {role} "
                    f"{name!r}{nearest(name, known)}"
                )


def _require_lines(w: Windowed, options: ResponseOptions, asked: Bool[np.ndarray, "k p m"]) -> None:
    for i, pair in enumerate(options.pairs):
        place = f"frequency.pairs[{i}] ({pair.input} to {pair.output})"
        if pair.input not in w.inputs:
            raise ValueError(f"{place}: {pair.input} does not move, expected an input that does")
        if pair.output not in w.outputs:
            why = w.left_out.get(pair.output, "it is not measured")
            raise ValueError(f"{place}: no response of {pair.output}; {why}")
        low, high = pair.band or (0.0, np.inf)
        if not np.any((w.hz >= low * (1 - 1e-9)) & (w.hz <= high * (1 + 1e-9))):
            raise ValueError(
                f"{place}: expected a band that holds a line of the window within {w.hz[0]:.3g} to "
                f"{w.hz[-1]:.3g} Hz, got {low:g} to {high:g} Hz"
            )
    if not asked.any():
        raise ValueError(
            "frequency: no response is left, expected one with the coherence asked for "
            f"({options.coherence:g}) in the mean over an octave"
        )


def _require_numbers(problem: Problem, weights: ResponseWeights) -> None:
    nuisance = problem.nuisance
    unknowns = len(problem.free) + nuisance.time_shift
    unknowns += len(naming.names(problem.model.Inputs)) if nuisance.input_gain else 0
    numbers = 2.0 * weights.numbers
    if numbers <= unknowns:
        raise ValueError(
            f"frequency: expected more independent numbers than the {unknowns} unknowns, got "
            f"{numbers:.2g} of the responses; a wider band, a longer window or a lower coherence"
        )


def on_device(weights: ResponseWeights) -> ResponseWeights:
    """The same, what a trace needs of it as JAX's arrays: copied once, not with every call."""
    return jax.tree.map(lambda v: jax.device_put(v) if isinstance(v, np.ndarray) else v, weights)


def back(weights: ResponseWeights) -> ResponseWeights:
    """The same in NumPy."""
    return jax.tree.map(lambda v: np.asarray(v) if isinstance(v, jax.Array) else v, weights)


# What the machine makes of gusts, as windows show it: a shape for the noise of responses.
#
# The noise's spectrum in windows is a mean over few of their lines. Gusts come through the
# machine's own modes, which are no wider than that: the mean makes a wide and low hill of a mode,
# and what the record tells of the mode is weighed by too much noise beside it and too little at it.
# So
#
# $$S_0 = \sum_i q_i \int |W|^2 h_i h_i^H + R, \qquad [h_1 \ldots h_n] = C (zI - A_d)^{-1}$$
#
# is found first, as in `frequency_gusts` but through the windows' own transform W, and the mean is
# taken of what is left where it is divided by that.
#
# Sources: Blackman and Tukey (1958) for prewhitening.


_APART = 0.04
"""part of the frequency within which lines are taken together"""
_UNSEEN = 1e-20
"""part of the largest power of a state's effect below which outputs do not show one"""
_OFFSETS = np.arange(-1.875, 2.0, 0.25)
"""from a line to the frequencies that a window brings to it, in lines: its main lobe. None of them
is zero, where integrations have no finite response"""


Described = Callable[[np.ndarray, list[int]], np.ndarray | None]
"""of raw spectral matrices (k, q, q) of some outputs, by their place in the windows, what the
machine makes of gusts, and white noise: (k, q, q), or None where that says nothing"""


def gusts_through(layout: Layout, data: Data, z: Float[Array, " q"], w: Windowed) -> Described:
    """The shape that the first flight's machine gives to the noise.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        z: the unknowns.
        w: the flights in windows.
    """
    seen = dataclasses.replace(layout, outputs=(w.outputs,) * len(data.flights))
    machine = machine_of(seen, data, z)
    return described(np.asarray(machine.Ad, float), np.asarray(machine.C, float), w)


class _Cells(NamedTuple):
    """Lines that are taken together."""

    first: np.ndarray
    """(c,) index of the first of each"""
    lines: np.ndarray
    """(c,) how many"""
    at: np.ndarray
    """(c,) their mean, in periods of a window"""


def described(Ad: Float[np.ndarray, "n n"], C: Float[np.ndarray, "p n"], w: Windowed) -> Described:
    """The shape that a machine gives to the noise.

    Args:
        Ad: from sample to sample.
        C: of the outputs in windows.
        w: the flights in windows.
    """
    cells = _cells(w.lines)
    # A line on a mode that does not decay has no finite response.
    with np.errstate(all="ignore"):
        ways = ways_of(Ad, C, cells.at, w.length)

    def of(raw: Complex[np.ndarray, "k q q"], outputs: list[int]) -> np.ndarray | None:
        size = np.sqrt(np.mean(np.real(np.einsum("kii->ki", raw)), axis=0))
        if not (np.isfinite(size).all() and (size > 0).all()):
            return None
        scale = size[:, None] * size[None, :]
        seen = ways[:, :, outputs][:, :, :, outputs] / scale
        fine = np.isfinite(seen).all((1, 2, 3))
        if not fine.any():
            return None
        # What rounding leaves of a state that no output shows would pass for a huge gust's way.
        effects = np.max(np.real(np.einsum("cnii->cni", seen[fine])), axis=(0, 2))
        seen = seen * (effects > _UNSEEN * np.max(effects))[:, None, None]
        power = np.add.reduceat(raw / scale, cells.first, axis=0) / cells.lines[:, None, None]
        f = cells.at / w.length
        shapes = shapes_of(f, corners_of(f))
        with np.errstate(all="ignore"):
            q, r = powers_of(seen[fine], shapes[:, fine], power[fine], cells.lines[fine])
            S = np.einsum("nb,bc,cnij->cij", q, shapes[:, fine], seen[fine])
        S = (S + np.diag(r)) * scale
        return _between(S, cells.at[fine], w.lines) if np.isfinite(S).all() else None

    return of


def _cells(lines: np.ndarray) -> _Cells:
    """Each line by itself at first, then those within a part of the frequency."""
    first = [0]
    while (end := np.searchsorted(lines, lines[first[-1]] * (1.0 + _APART), "right")) < lines.size:
        first.append(int(end))
    counts = np.diff(np.append(first, lines.size)).astype(float)
    return _Cells(np.array(first), counts, np.add.reduceat(lines.astype(float), first) / counts)


def ways_of(
    Ad: Float[np.ndarray, "n n"],
    C: Float[np.ndarray, "p n"],
    lines: Float[np.ndarray, " c"],
    length: int,
) -> Complex[np.ndarray, "c n p p"]:
    """By line and state what windows show of the outputs in white gusts of power 1.

    Args:
        Ad: from sample to sample.
        C: of the outputs.
        lines: in periods of a window.
        length: of a window, in samples.
    """
    f = lines[:, None] + _OFFSETS
    z = np.exp(2j * np.pi * f / length)[:, :, None, None]
    H = np.swapaxes(C @ np.linalg.inv(z * np.eye(len(Ad)) - Ad), 2, 3)
    weights = _weights(lines, length)
    return np.einsum("co,conp,conq->cnpq", weights, H, np.conj(H), optimize=True)


def _weights(lines: Float[np.ndarray, " c"], length: int) -> Float[np.ndarray, "c o"]:
    """How much of the power at each offset windows bring to a line."""
    t, window = np.arange(length), hann(length)
    lobe = np.exp(2j * np.pi * np.outer(_OFFSETS, t) / length) @ window
    # What the mean of a window takes off is a part of the first line.
    constant = np.exp(2j * np.pi * np.outer(1.0 + _OFFSETS, t) / length).sum(axis=1)
    mean = np.mean(window * np.exp(-2j * np.pi * t / length))
    seen = np.where(lines[:, None] < 1.5, lobe - mean * constant, lobe)
    return np.abs(seen) ** 2 / np.sum(np.abs(lobe) ** 2)


def _between(
    S: Complex[np.ndarray, "c p p"], at: Float[np.ndarray, " c"], lines: np.ndarray
) -> Complex[np.ndarray, "k p p"]:
    """Straight lines from cell to cell."""
    low = np.clip(np.searchsorted(at, lines, side="right") - 1, 0, max(len(at) - 2, 0))
    high = np.minimum(low + 1, len(at) - 1)
    part = np.clip((lines - at[low]) / np.maximum(at[high] - at[low], 1e-300), 0.0, 1.0)
    return S[low] + part[:, None, None] * (S[high] - S[low])
