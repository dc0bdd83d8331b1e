"""Reduced model of one axis (eqs 21-22), its transfer function (eq. 23), and the stand.

Roll and pitch share the functions; they differ in the inertia and the names of the states. `Ixx`
and `If` estimated with these equations are valid only in this model: see `cyclic_moment`, and the
README for differences between paper and physics.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.aerodynamics import cyclic_moment
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.flybar import cyclic_pitch, flapping_acceleration, flapping_rate_gain
from heli_jax.dynamics.model import PITCH, ROLL, Axis, Model, axes_of
from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter


class RollState(NamedTuple):
    phi: Annotated[Scalar, "rad", "roll angle"]
    dphi: Annotated[Scalar, "rad/s", "roll rate"]
    beta_roll: Annotated[Scalar, "rad", "flybar angle"]
    dbeta_roll: Annotated[Scalar, "rad/s", "flybar rate"]


class RollInputs(NamedTuple):
    x_roll: Annotated[Scalar, "m", "cyclic input displacement, roll"]


class RollOutputs(NamedTuple):
    roll: Annotated[Scalar, "rad", "roll angle"]
    roll_rate: Annotated[Scalar, "rad/s", "roll rate"]


class PitchState(NamedTuple):
    theta: Annotated[Scalar, "rad", "pitch angle"]
    dtheta: Annotated[Scalar, "rad/s", "pitch rate"]
    beta_pitch: Annotated[Scalar, "rad", "flybar angle"]
    dbeta_pitch: Annotated[Scalar, "rad/s", "flybar rate"]


class PitchInputs(NamedTuple):
    x_pitch: Annotated[Scalar, "m", "cyclic input displacement, pitch"]


class PitchOutputs(NamedTuple):
    pitch: Annotated[Scalar, "rad", "pitch angle"]
    pitch_rate: Annotated[Scalar, "rad/s", "pitch rate"]


def roll_inertia(p: Helicopter) -> Scalar:
    """Return Ixx plus the added inertia [kg m^2]."""
    return p.Ixx + p.Ixx_added


def pitch_inertia(p: Helicopter) -> Scalar:
    """Return Iyy plus the added inertia [kg m^2]."""
    return p.Iyy + p.Iyy_added


def roll_acceleration(p: Helicopter, x_roll: Scalar, beta: Scalar) -> Scalar:
    r"""Return the roll acceleration [rad/s^2], eq. 22: eqs 5, 11 and 14.

    $$\ddot\phi = \frac{\rho\Omega^2 a c R^4}{2 I_{xx} L_1 (L_2+L_3)}
      (L_3 x_{roll} + L_2 L_4 \beta)$$

    Args:
        x_roll: cyclic input displacement [m].
        beta: flapping angle of the flybar about the same axis [rad].
    """
    # `a` enters eqs 21-22 only as a/If and a/Ixx, so a common factor of Ixx, If and a has no
    # effect. Roll data give two ratios; the third number needs a prior or an added inertia.
    return (1.0 / roll_inertia(p)) * cyclic_moment(p, p.Omega, cyclic_pitch(p, x_roll, beta))


def pitch_acceleration(p: Helicopter, x_pitch: Scalar, beta: Scalar) -> Scalar:
    """Return the pitch acceleration [rad/s^2]: eqs 6, 11 and 15, as in eq. 22 for roll.

    Args:
        x_pitch: cyclic input displacement [m].
        beta: flapping angle of the flybar about the same axis [rad].
    """
    # Without -T lr of eq. 6: trim balances it in hover, and this is the motion about trim.
    return (1.0 / pitch_inertia(p)) * cyclic_moment(p, p.Omega, cyclic_pitch(p, x_pitch, beta))


def _roll_field(p: Helicopter, s: RollState, u: RollInputs) -> RollState:
    """Return the rates of eqs 21 and 22."""
    return RollState(
        phi=s.dphi,
        dphi=roll_acceleration(p, u.x_roll, s.beta_roll),
        beta_roll=s.dbeta_roll,
        dbeta_roll=flapping_acceleration(p, p.Omega, u.x_roll, s.beta_roll, s.dbeta_roll, s.dphi),
    )


def _pitch_field(p: Helicopter, s: PitchState, u: PitchInputs) -> PitchState:
    """Return the rates of eqs 21 and 22 for the pitch axis."""
    return PitchState(
        theta=s.dtheta,
        dtheta=pitch_acceleration(p, u.x_pitch, s.beta_pitch),
        beta_pitch=s.dbeta_pitch,
        dbeta_pitch=flapping_acceleration(
            p, p.Omega, u.x_pitch, s.beta_pitch, s.dbeta_pitch, s.dtheta
        ),
    )


def _roll_output(p: Helicopter, s: RollState, u: RollInputs) -> RollOutputs:
    return RollOutputs(roll=s.phi, roll_rate=s.dphi)


def _pitch_output(p: Helicopter, s: PitchState, u: PitchInputs) -> PitchOutputs:
    return PitchOutputs(pitch=s.theta, pitch_rate=s.dtheta)


roll = Model(
    "roll",
    _roll_field,
    _roll_output,
    Helicopter,
    RollState,
    RollInputs,
    RollOutputs,
    linear=True,
    # No tip-path plane: the moment of eq. 14 follows the cyclic pitch at once.
    axes=(ROLL._replace(tilt=()),),
)
"""Free roll at constant rotor speed: eqs 21-22."""

pitch = Model(
    "pitch",
    _pitch_field,
    _pitch_output,
    Helicopter,
    PitchState,
    PitchInputs,
    PitchOutputs,
    linear=True,
    axes=(PITCH._replace(tilt=()),),
)
"""Free pitch at constant rotor speed: eqs 21-22 with Iyy."""


@functools.cache
def on_stand(model: Model) -> Model:
    r"""Return the model with the stand's stiffness and damping on its roll (and pitch) axis.

    $$\ddot\phi \mathrel{-}= (\kappa\phi + \zeta\dot\phi)\,I_{xx}/(I_{xx} + I_{xx,added})$$

    `kappa` [1/s^2] and `zeta` [1/s] refer to the vehicle without added inertia. So the stand's
    stiffness kappa Ixx [N m/rad] and damping zeta Ixx are the same in all runs.

    Raises:
        ValueError: the model has no axis with an angle, an inertia and an added inertia.
    """
    check_model(model)
    # The stand has springs only about roll and pitch, so yaw stays free.
    axes = [a for a in axes_of(model) if a.angle and a.inertia and a.added_inertia]
    if not axes:
        raise ValueError(f"model {model.name!r} has no roll or pitch axis for a stand")

    def vector_field(p: Record, s: Record, u: Record) -> Record:
        """Return the model's derivatives with the stand's moments."""
        rates = model.vector_field(p, s, u)
        for axis in axes:
            inertia, added = _inertias(p, axis)
            # kappa and zeta are per unit of the vehicle's own inertia, and an added known inertia
            # reduces their effect. Runs with and without it share them, which separates a from Ixx.
            pull = p.kappa * getattr(s, str(axis.angle)) + p.zeta * getattr(s, axis.rate)
            slowed = getattr(rates, axis.rate) - (inertia / (inertia + added)) * pull
            rates = naming.replace(rates, **{axis.rate: slowed})
        return rates

    return dataclasses.replace(model, name=f"{model.name}-on-stand", vector_field=vector_field)


def _inertias(p: Record, axis: Axis) -> tuple[Scalar, Scalar]:
    """Return an axis's own inertia and its added inertia [kg m^2]."""
    return getattr(p, str(axis.inertia)), getattr(p, str(axis.added_inertia))


class TransferFunction(NamedTuple):
    """Polynomials in s, highest power first."""

    num: tuple[Scalar, ...]
    den: tuple[Scalar, ...]


def roll_transfer_function(p: Helicopter, *, stand: bool = False) -> TransferFunction:
    r"""Return $H(s) = \phi/x_{roll}$ in closed form, eq. 23, optionally with the stand.

    $$H = \frac{d_1 s^2 + d_2 s + d_3}{s(s^3 + c_1 s^2 + c_2 s + c_3)}$$

    On the stand the denominator is $(s^2 + \zeta s + \kappa)(s^2 + c_1 s + c_2) + c_3 s$. num has
    3 and den 5 coefficients.
    """
    # Written by hand; a test compares it with `linearize`, which differentiates the model.
    k1 = flapping_rate_gain(p)
    # The moment is linear in the cyclic pitch; k2 is that of a bracket (L3 x + L2 L4 beta) of one.
    k2 = cyclic_moment(p, p.Omega, 1.0 / (p.L1 * (p.L2 + p.L3))) / roll_inertia(p)
    # The stand's constants are per unit of the vehicle's own inertia, as in `on_stand`.
    share = p.Ixx / roll_inertia(p)
    c1, c2, c3 = k1 / p.Omega, p.Omega**2, k1 * k2 * p.L2 * p.L4 / p.Omega
    # Zeros and ones computed from k1 have its type and batch axis.
    kappa, zeta = (share * p.kappa, share * p.zeta) if stand else (0.0 * k1, 0.0 * k1)
    # The last is d3 = k2 (L3 Omega^2 + L2 L4 k1/L5). Apart from the pole at the origin, the system
    # is stable if and only if Omega^2 > k2 L2 L4 (Routh).
    num = (k2 * p.L3, k1 * k2 * p.L3 / p.Omega, k2 * (p.L3 * c2 + p.L2 * p.L4 * k1 / p.L5))
    one = k1 / k1
    den = (one, c1 + zeta, c2 + zeta * c1 + kappa, zeta * c2 + kappa * c1 + c3, kappa * c2)
    return TransferFunction(num, den)


class Ratios(NamedTuple):
    """Ratios of physical parameters that a fourth-order denominator determines."""

    values: dict[str, Scalar]
    """a over the inertia of the axis, and a/If (a_paddle/If if a_paddle is given)."""
    p2: Scalar
    p2_expected: Scalar
    """Coefficient of s^2 expected from the other coefficients and Omega."""


def ratios_from_denominator(
    p: Helicopter, den: Sequence[Scalar] | np.ndarray | Array, angle: str = "roll"
) -> Ratios:
    r"""Return a/Ixx and a/If from the denominator of an identified fourth-order H(s), eq. 23.

    With $c_1 = p_1 - \zeta$ and $c_3 = p_3 - \zeta c_2 - \kappa c_1$, k1 and k2 follow. If
    `a_paddle` is given (concrete), the paddle's lift slope is not `a`, and k1 gives a_paddle/If.

    Args:
        p: vehicle, SI; the stand's zeta, the geometry and Omega are used.
        den: (1, p1, p2, p3, p4), highest power of s first.
    """
    # Four coefficients cannot give five unknowns: zeta is assumed known, kappa is p4/c2, and Omega
    # is measured. The expected p2 = c2 + zeta c1 + kappa is then a check of the model.
    axis = {"roll": ROLL, "pitch": PITCH}[angle]
    inertia, added = _inertias(p, axis)
    zeta, c2 = p.zeta * inertia / (inertia + added), p.Omega**2
    _, p1, p2, p3, p4 = den
    kappa, c1 = p4 / c2, p1 - zeta
    c3 = p3 - zeta * c2 - kappa * c1
    k1 = c1 * p.Omega
    k2 = c3 * p.Omega / (k1 * p.L2 * p.L4)
    slope = "a_paddle" if _is_given(p.a_paddle) else "a"
    # Moment and k1 are proportional to a and to 1/If, so their values at one are the factors of the
    # ratios.
    unit_a = naming.replace(p, **{"a": 1.0, "If": 1.0, slope: 1.0})
    moment_per_a = cyclic_moment(unit_a, p.Omega, 1.0 / (p.L1 * (p.L2 + p.L3)))
    over = f"a/{axis.inertia}"
    total = k2 / moment_per_a  # a over the inertia including the added one
    k1_per_ratio = flapping_rate_gain(unit_a)
    ratios = {over: total * (inertia + added) / inertia, f"{slope}/If": k1 / k1_per_ratio}
    return Ratios(ratios, p2, c2 + zeta * c1 + kappa)


def _is_given(value: Scalar) -> bool:
    """True if an optional constant is given; False if it is traced, where that is unknown."""
    return not isinstance(value, core.Tracer) and not bool(jnp.isnan(value))
