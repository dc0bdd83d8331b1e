"""Linearised models: named matrices and modes."""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.dynamics.jacobians import StateSpace, jacobians
from heli_jax.dynamics.model import Model, axes_of
from heli_jax.dynamics.onboard.delays import require_past

# Params, State and Inputs are classes of the user's: `Any` below.


class Linearization(NamedTuple):
    """A, B, C, D about a point, with the names of their rows and columns."""

    matrices: StateSpace
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def to_control(self) -> Any:  # python-control is an extra: its class cannot be named here
        """The same as a `control.StateSpace` of python-control, with its names.

        Raises:
            ImportError: python-control is not installed.
        """
        try:
            import control
        except ImportError as e:
            raise ImportError(
                "to_control: python-control is not installed; remedy: pip install control"
            ) from e
        A, B, C, D = (np.asarray(M, np.float64) for M in self.matrices)
        names = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        return control.ss(A, B, C, D, **{k: list(v) for k, v in names.items()})


def linearize(model: Model, params: Any, state: Any = None, inputs: Any = None) -> Linearization:
    """The model's matrices at a point.

    Args:
        state: the model's initial state unless given.
        inputs: zeros unless given.
    """
    return Linearization(
        jacobians(model, params, state, inputs),
        naming.names(model.State),
        naming.names(model.Inputs),
        naming.names(model.Outputs),
    )


def modes(model: Model, params: Any, state: Any = None, inputs: Any = None) -> np.ndarray:
    """Eigenvalues of A [1/s], (n,) complex, slowest first.

    Args:
        state: the model's initial state unless given.
        inputs: zeros unless given.

    Raises:
        ValueError: the delay of a delay line is negative.
    """
    require_past(model, params)
    eigenvalues = np.linalg.eigvals(np.asarray(jacobians(model, params, state, inputs).A))
    return eigenvalues[np.argsort(np.abs(eigenvalues))]


class Mode(NamedTuple):
    """A motion of its own."""

    eigenvalue: complex
    """[1/s]; of a pair the one with the positive imaginary part"""
    name: str
    """what moves most, as 'roll with flybar roll', or 'phugoid'"""
    frequency: float
    """undamped, |eigenvalue| [rad/s]"""
    damping: float
    """ratio, 1 for a motion that does not oscillate, negative where it grows"""
    shares: dict[str, float]
    """of each state in the mode; they add up to 1"""


# Which motion a state that belongs to no axis is of; others stand for themselves.
_MOTIONS = {
    "x": "surge", "dx": "surge", "y": "sway", "dy": "sway", "z": "heave", "dz": "heave",
    "Omega": "rotor speed", "governor": "governor", "vi": "inflow",
}  # fmt: skip
_TAKES_PART = 0.2
"""share of a motion in a mode from which on the mode has its name too"""
_STILL = 1e-9
"""of the fastest eigenvalue (or 1/s): slower is zero, which rounding has spread"""


def eigenmodes(
    model: Model, params: Any, state: Any = None, inputs: Any = None
) -> tuple[Mode, ...]:
    """The modes of the linearisation, slowest first, named by the states that take part.

    A state's share is its participation factor |left x right eigenvector|; in a mode that does not
    move (an eigenvalue of zero, a position or a heading) it is the right eigenvector's alone.

    Args:
        state: the model's initial state unless given.
        inputs: zeros unless given.

    Raises:
        ValueError: the delay of a delay line is negative.
    """
    require_past(model, params)
    A = np.asarray(jacobians(model, params, state, inputs).A, np.float64)
    values, left, right = scipy.linalg.eig(A, left=True)
    # At least 1/s: of a model that does not move at all every eigenvalue is zero.
    largest = max(float(np.max(np.abs(values), initial=0.0)), 1.0)
    names, motions, result = naming.names(model.State), _motions(model), []
    for i in np.argsort(np.abs(values), kind="stable"):
        value = complex(values[i])
        if value.imag < 0:  # the other one of its pair tells the same
            continue
        still = abs(value) < _STILL * largest
        # The product does not depend on units. Of several zeros the left eigenvectors are any that
        # span the same space, so that products say nothing.
        part = np.abs(right[:, i]) if still else np.abs(left[:, i] * right[:, i])
        part = part / np.sum(part)
        shares = dict(zip(names, (float(p) for p in part), strict=True))
        size = abs(value)
        # A mode that stays where it is does not oscillate; the ratio itself is rounding over
        # rounding.
        damping = 1.0 if still else -value.real / size
        result.append(Mode(value, _mode_name(shares, motions), size, damping, shares))
    return tuple(result)


def _motions(model: Model) -> dict[str, str]:
    """The motion that each state belongs to."""
    motions, axes = dict(_MOTIONS), axes_of(model)
    # Along the axes of the body where the rates are about these; alone, w may be anything.
    if any(axis.rate in ("p", "q", "r") for axis in axes):
        motions |= {"u": "surge", "v": "sway", "w": "heave"}
    if any(axis.name == "heave" for axis in axes):
        motions["nu"] = "inflow"
    for axis in axes:
        motions |= {n: axis.name for n in (axis.angle, axis.rate) if n is not None}
        motions |= dict.fromkeys(axis.flybar, f"flybar {axis.name}")
        motions |= dict.fromkeys(axis.tilt, f"{axis.name} flapping")
    return motions


def _mode_name(shares: dict[str, float], motions: dict[str, str]) -> str:
    by_motion: dict[str, float] = {}
    for name, share in shares.items():
        motion = motions.get(name, name)
        by_motion[motion] = by_motion.get(motion, 0.0) + share
    ordered = sorted(by_motion, key=lambda m: -by_motion[m])
    part = [m for m in ordered if by_motion[m] >= _threshold(m)]
    # The body before what moves with it.
    part = sorted(part or ordered[:1], key=lambda m: m.startswith(("flybar", "rotor", "inflow")))
    return " with ".join(_known(part))


def _threshold(motion: str) -> float:
    # The tilt is one state where a body has two, an angle and its rate.
    return 0.75 * _TAKES_PART if motion.endswith("flapping") else _TAKES_PART


def _known(part: list[str]) -> list[str]:
    """The motions of a mode, those that have a name of their own together under it."""
    # Attitude and speed in turn, each driving the other: the pitch's is the phugoid of books.
    for axis, along, name in (("pitch", "surge", "phugoid"), ("roll", "sway", "lateral phugoid")):
        if {axis, along} <= set(part):
            part = [name, *(m for m in part if m not in (axis, along))]
    # A body that swings against its rotor is one motion.
    for axis in ("roll", "pitch"):
        if {axis, f"{axis} flapping"} <= set(part):
            part = [m for m in part if m != axis]
    return part
