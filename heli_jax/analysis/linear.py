"""Linearised models: named matrices and modes."""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.dynamics.jacobians import StateSpace, jacobians
from heli_jax.dynamics.model import Model, axes_of, require_continuous
from heli_jax.dynamics.onboard.delays import require_past

# Params, State and Inputs are the user's classes, hence `Any` below.


class Linearization(NamedTuple):
    """Matrices A, B, C, D at a point, with the names of their rows and columns."""

    matrices: StateSpace
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def to_control(self) -> Any:  # python-control is an extra: its class cannot be named here
        """Return a `control.StateSpace` of python-control with the same names.

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
    """Return the model's matrices at a point.

    Args:
        state: default: the model's initial state.
        inputs: default: zeros.

    Raises:
        ValueError: the model contains a controller (see `heli_jax.control.loops`).
    """
    require_continuous(model, "linearize")
    return Linearization(
        jacobians(model, params, state, inputs),
        naming.names(model.State),
        naming.names(model.Inputs),
        naming.names(model.Outputs),
    )


def modes(model: Model, params: Any, state: Any = None, inputs: Any = None) -> np.ndarray:
    """Return the eigenvalues of A [1/s], (n,) complex, slowest first.

    Args:
        state: default: the model's initial state.
        inputs: default: zeros.

    Raises:
        ValueError: the delay of a delay line is negative.
    """
    require_past(model, params)
    require_continuous(model, "modes")
    eigenvalues = np.linalg.eigvals(np.asarray(jacobians(model, params, state, inputs).A))
    return eigenvalues[np.argsort(np.abs(eigenvalues))]


class Mode(NamedTuple):
    """An eigenmode."""

    eigenvalue: complex
    """Eigenvalue [1/s]; for a pair, the one with positive imaginary part."""
    name: str
    """Dominant motion, such as 'roll with flybar roll', or 'phugoid'."""
    frequency: float
    """Undamped frequency |eigenvalue| [rad/s]."""
    damping: float
    """Damping ratio; 1 without oscillation, negative for a growing mode."""
    shares: dict[str, float]
    """Share of each state in the mode; the sum is 1."""


# Motions of states that belong to no axis; other states stand for themselves.
_MOTIONS = {
    "x": "surge", "dx": "surge", "y": "sway", "dy": "sway", "z": "heave", "dz": "heave",
    "Omega": "rotor speed", "governor": "governor", "vi": "inflow",
}  # fmt: skip
_TAKES_PART = 0.2
"""Least share of a motion in a mode for the mode's name to include it."""
_STILL = 1e-9
"""Largest eigenvalue that counts as zero after rounding [fraction of the fastest, or of 1/s]."""


def eigenmodes(
    model: Model, params: Any, state: Any = None, inputs: Any = None
) -> tuple[Mode, ...]:
    """Return the modes of the linearisation, slowest first, named by the dominant states.

    A state's share is its participation factor |left x right eigenvector|; for an eigenvalue of
    zero (a position or a heading) it is that of the right eigenvector alone.

    Args:
        state: default: the model's initial state.
        inputs: default: zeros.

    Raises:
        ValueError: the delay of a delay line is negative.
    """
    require_past(model, params)
    A = np.asarray(jacobians(model, params, state, inputs).A, np.float64)
    values, left, right = scipy.linalg.eig(A, left=True)
    # At least 1/s, since all eigenvalues may be zero.
    largest = max(float(np.max(np.abs(values), initial=0.0)), 1.0)
    names, motions, result = naming.names(model.State), _motions(model), []
    for i in np.argsort(np.abs(values), kind="stable"):
        value = complex(values[i])
        if value.imag < 0:  # its conjugate has the same content
            continue
        still = abs(value) < _STILL * largest
        # The product does not depend on units. For several zeros, left eigenvectors are an
        # arbitrary basis of their space, so products are meaningless.
        part = np.abs(right[:, i]) if still else np.abs(left[:, i] * right[:, i])
        part = part / np.sum(part)
        shares = dict(zip(names, (float(p) for p in part), strict=True))
        size = abs(value)
        # A mode with zero eigenvalue does not oscillate; its ratio would be rounding over rounding.
        damping = 1.0 if still else -value.real / size
        result.append(Mode(value, _mode_name(shares, motions), size, damping, shares))
    return tuple(result)


def _motions(model: Model) -> dict[str, str]:
    """Return the motion of each state."""
    motions, axes = dict(_MOTIONS), axes_of(model)
    # Body axes if the rates are body rates. Otherwise w may mean anything.
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
    # Name the body before motions relative to it.
    part = sorted(part or ordered[:1], key=lambda m: m.startswith(("flybar", "rotor", "inflow")))
    return " with ".join(_known(part))


def _threshold(motion: str) -> float:
    # Tilt is one state, while a body axis has two, an angle and its rate.
    return 0.75 * _TAKES_PART if motion.endswith("flapping") else _TAKES_PART


def _known(part: list[str]) -> list[str]:
    """Merge motions of a mode that together have a name of their own."""
    # Attitude and speed that drive each other in turn; in pitch this is the phugoid of textbooks.
    for axis, along, name in (("pitch", "surge", "phugoid"), ("roll", "sway", "lateral phugoid")):
        if {axis, along} <= set(part):
            part = [name, *(m for m in part if m not in (axis, along))]
    # A body that swings against its rotor is one motion.
    for axis in ("roll", "pitch"):
        if {axis, f"{axis} flapping"} <= set(part):
            part = [m for m in part if m != axis]
    return part
