"""Modes that the samples cannot show, and the free parameters that move them.

Samples at a rate f show a mode at w + 2 pi f as they show one at w. So an optimum whose mode lies
past the Nyquist frequency is one of many that fit as well, each with a narrow interval of its own.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import OperatingPoint, operating_point
from heli_jax.flights.flight import Flight
from heli_jax.identification.identifiability.equivalents import SAME, Valley
from heli_jax.identification.problem import Problem
from heli_jax.numerics.white_noise import white_part

_NEAR, _AT_NYQUIST = 0.8, 0.9
"""parts of the Nyquist frequency from which on the samples hardly show a mode: from the first its
alias is tried, from the second nobody has to ask"""
_MOVED = 1e-6
"""relative change of a mode, for a relative change of a parameter, that is none"""
_TURNED = 0.2
"""the same of its frequency from which on a parameter can take the mode to an alias; a frequency
that goes with the parameter's root has 0.5"""
_SWINGS = 10.0
"""frequency over decay of a mode that is called a swing, however soon it is over: its cycle is lost
between the samples, and any other frequency past them fits as well"""
_STEP = 1e-4
"""relative step of the parameters for these changes"""
SHOWS = 3.0
"""times the noise by which a mode moves an output, from which on it matters"""

# params is Any: a record of a model's Params, whose class may be a user's own.


class FastMode(NamedTuple):
    """A mode of a flight at or past the Nyquist frequency that free parameters move."""

    flight: str
    frequency: float
    """[rad/s]"""
    nyquist: float
    """[rad/s]"""
    about: str
    """where the model was linearised; empty for a linear one"""
    undetermined: tuple[str, ...]
    """the free parameters that can take it to an alias, where it shows in an output"""
    turning: tuple[tuple[str, float], ...] = ()
    """those that can, whether it shows or not, each with the factor that takes it there"""


def measurement_noise(
    problem: Problem, sd: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, float], ...]:
    """By flight and output the sd that residuals leave to noise, less what a model misses, SI."""
    # What a wrong optimum misses passes for noise in its residuals, and would hide its fast mode.
    return tuple(
        {n: max(min(float(s), white_part(flight.outputs[n])), 1e-300) for n, s in one.items()}
        for flight, one in zip(problem.training, sd, strict=True)
    )


class Modes(NamedTuple):
    """A linearised model along its eigenvectors."""

    eigenvalues: np.ndarray
    """(n,) [1/s]"""
    right: np.ndarray
    """(n, n) a mode a column"""
    left: np.ndarray
    """(n, n) a mode a row"""
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray

    def strongest(
        self, k: int, problem: Problem, flight: Flight, noise: Mapping[str, Any]
    ) -> tuple[float, str, str]:
        """The part of mode k in the answer of an output to a step of an input's size, over the
        output's noise, where that is largest: with the input's and the output's name. Where no
        input moves, in the free motion: of the modes that the output shows best all of it.

        Args:
            noise: sd by output, SI.
        """
        outputs = naming.names(problem.model.Outputs)
        best = (0.0, "", "")
        if not any(np.ptp(u) > 0 for u in flight.inputs.values()):
            for y in flight.outputs:
                shown = np.abs(self.C[outputs.index(y)] @ self.right)
                shown *= np.linalg.norm(self.left, axis=1)
                part = shown[k] / max(float(shown.max()), 1e-300)
                best = max(best, (part * np.nanstd(flight.outputs[y]) / float(noise[y]), "", y))
            return best
        for j, u in enumerate(naming.names(problem.model.Inputs)):
            size = float(np.std(flight.inputs[u]))
            for y in flight.outputs:
                residue = abs(self.C[outputs.index(y)] @ self.right[:, k])
                residue *= abs(self.left[k] @ self.B[:, j])
                part = residue / abs(self.eigenvalues[k]) * size / float(noise[y])
                best = max(best, (part, u, y))
        return best


def modes_about(problem: Problem, params: Any, at: OperatingPoint) -> Modes | None:
    """The model's modes about a point; None where its matrices are not finite.

    Args:
        params: of the flight, SI.
        at: where the model is linearised.
    """
    matrices = linearize(problem.model, params, at.state, at.inputs).matrices
    A, B, C, _ = (np.asarray(M, np.float64) for M in matrices)
    if not all(np.isfinite(M).all() for M in (A, B, C)):
        return None
    eigenvalues, right = np.linalg.eig(A)
    # A defective matrix has no inverse of its vectors: the least squares one spreads the residues.
    return Modes(eigenvalues, right, np.linalg.pinv(right), A, B, C)


def fast_modes(
    problem: Problem,
    values: Mapping[str, float],
    noise: Sequence[Mapping[str, Any]] | None = None,
) -> list[FastMode]:
    """For each fitted flight the fastest mode that its samples cannot show and that is not known.

    Args:
        values: of the free parameters, SI; gains and shifts among them move no mode.
        noise: sd by flight and output, SI; without it nothing is said to be undetermined.
    """
    free = {n: v for n, v in values.items() if n in problem.free}
    modes = []
    for i, flight in enumerate(problem.training):
        here = free | flight.known
        at = operating_point(
            problem.model,
            problem.params_with(here),
            flight.inputs,
            flight.outputs,
            flight.dt,
            substeps=problem.substeps,
        )
        moving = [n for n in free if n not in flight.known]
        fast = _of_flight(problem, flight, here, at, moving, noise[i] if noise else None)
        modes += [] if fast is None else [fast]
    return modes


def _of_flight(
    problem: Problem,
    flight: Flight,
    here: Mapping[str, float],
    at: OperatingPoint,
    moving: list[str],
    noise: Mapping[str, Any] | None,
) -> FastMode | None:
    modes = modes_about(problem, problem.params_with(here), at)
    if modes is None:
        return None
    nyquist = np.pi / flight.dt
    # The imaginary part alone: a fast decay without oscillation has no alias.
    past = [k for k, v in enumerate(modes.eigenvalues) if v.imag >= _NEAR * nyquist]
    if not past:
        return None
    slopes = _relative_slopes(problem, here, at, moving, modes)
    # A filter or a servo whose constants are given is simulated as it is, and has no alias.
    past = [k for k in past if any(abs(s[k]) > _MOVED for s in slopes.values())]
    if not past:
        return None
    slopes = {n: s for n, s in slopes.items() if not _known_otherwise(problem, n)}
    undetermined = [
        n
        for n, slope in slopes.items()
        if noise is not None
        and any(
            abs(slope[k].imag) > _TURNED
            and modes.eigenvalues[k].imag >= _AT_NYQUIST * nyquist
            # What is gone within a sample swings in none, under any alias, unless it swings many
            # times before it is gone: then its frequency was told by nothing.
            and (
                -modes.eigenvalues[k].real * flight.dt < 1.0
                or abs(modes.eigenvalues[k].imag) > -modes.eigenvalues[k].real * _SWINGS
            )
            and modes.strongest(k, problem, flight, noise)[0] >= SHOWS
            for k in past
        )
    ]
    first = max(past, key=lambda k: float(modes.eigenvalues[k].imag))
    fastest = float(modes.eigenvalues[first].imag)
    # By powers: that is how a frequency goes with a stiffness or a time constant.
    turned = {n: float(s[first].imag) for n, s in slopes.items() if abs(s[first].imag) > _TURNED}
    other = (2.0 * nyquist - fastest) / fastest
    turning = tuple((n, other ** (1.0 / s)) for n, s in turned.items() if other > 0)
    label = flight.name or "the flight"
    return FastMode(label, fastest, nyquist, at.words, tuple(undetermined), turning)


_AS_GOOD = 0.02
"""of the sum of squares by which an alias may be worse and still fit as well: where a model lacks
something, chi-squared's few squares tell nothing"""


def as_good_as_aliases(modes: Sequence[FastMode], valley: Valley) -> list[FastMode]:
    """The modes, each with the parameters that take it to an alias which fits as well.

    Args:
        modes: of `fast_modes` at an optimum.
    """
    # A filter's rows hold the level of its variances too, and no squares to take a part of.
    if valley.at.layout.noise_model != "white":
        return list(modes)
    values = dict(zip(valley.at.layout.of_interest, valley.e.named, strict=True))
    worse = max(SAME, _AS_GOOD * float(np.sum(np.square(np.asarray(valley.e.r, np.float64)))))
    aliased = []
    for mode in modes:
        more = []
        for name, factor in () if mode.undetermined else mode.turning:
            point = valley.visit({name: float(values[name]) * factor}, {}, priors=True)
            more += [name] if point is not None and point.excess <= worse else []
        aliased.append(mode._replace(undetermined=(*mode.undetermined, *more)))
    return aliased


def _known_otherwise(problem: Problem, name: str) -> bool:
    """Whether a parameter's alias is excluded by its prior, or it is a delay, whose modes are an
    approximation's."""
    return problem.free[name].prior is not None or name in problem.model.delay_parameters


def _relative_slopes(
    problem: Problem,
    here: Mapping[str, float],
    at: OperatingPoint,
    names: Sequence[str],
    modes: Modes,
) -> dict[str, np.ndarray]:
    """By parameter of every eigenvalue (n,) complex its change over its size, for a relative change
    of that parameter: first-order perturbation of a simple eigenvalue."""
    slopes = {}
    for name in names:
        value = here[name]
        there = problem.params_with({**here, name: value + _STEP * (abs(value) or 1.0)})
        A = linearize(problem.model, there, at.state, at.inputs).matrices.A
        slope = (np.asarray(A, np.float64) - modes.A) / _STEP
        changes = np.einsum("ki,ij,jk->k", modes.left, slope, modes.right)
        slopes[name] = changes / np.maximum(np.abs(modes.eigenvalues), 1e-300)
    return slopes
