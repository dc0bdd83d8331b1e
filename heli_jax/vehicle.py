"""Helicopter: all constants of the paper's nomenclature, in SI.

Symbols are those of Kim & Tilbury (1997), appendix; `R1` is the inner and `R2` the outer end of the
flybar paddle. The paper's nomenclature exchanges them, which would make the flybar's damping
negative.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from heli_jax import naming, units
from heli_jax.errors import InputError, require_known
from heli_jax.naming import Record, Scalar
from heli_jax.yaml_file import EDIT, read_mapping


def _scalar(value: Any) -> Any:
    """Convert Python and NumPy numbers to arrays of the default float; return anything else
    unchanged.
    """
    # Tracers, batches and placeholders of JAX's tree functions stay as they are. A pytree's class
    # must accept any leaves.
    if isinstance(value, (bool, int, float, np.floating, np.integer)):
        return jnp.asarray(value, dtype=jnp.result_type(float))
    return value


# Any, since the default has another type than the declared Scalar.
def _field(default: float | None = None, *, kw_only: bool = False) -> Any:
    if default is None:
        return eqx.field(converter=_scalar, kw_only=kw_only)
    return eqx.field(converter=_scalar, default=default)


def _absent() -> Any:
    return _field(math.nan)


class Helicopter(eqx.Module):
    """A single-rotor helicopter with a Bell-Hiller flybar; every field a scalar in SI.

    A NaN marks a field that is not given; models that read it refuse the vehicle. The exceptions
    are `c_paddle` and `a_paddle`: by default the paddle has the blade's chord and lift slope, as in
    the paper. An estimated If then exceeds a measured one by the factor a c / (a_paddle c_paddle).
    """

    # Fields of the reduced roll model have no default. Fields of the whole helicopter alone default
    # to NaN, which `missing_parameters` reports.
    Ixx: Annotated[Scalar, "kg m^2", "fuselage inertia about the roll axis"] = _field()
    If: Annotated[Scalar, "kg m^2", "flybar inertia in flapping"] = _absent()
    R: Annotated[Scalar, "m", "length of a main rotor blade"] = _field(kw_only=True)
    c: Annotated[Scalar, "m", "main rotor blade chord"] = _field(kw_only=True)
    a: Annotated[Scalar, "1/rad", "main rotor lift slope"] = _field(kw_only=True)
    # A vehicle without a flybar lacks these.
    R1: Annotated[Scalar, "m", "rotor axis to the inner end of the flybar paddle"] = _absent()
    R2: Annotated[Scalar, "m", "rotor axis to the outer end of the flybar paddle"] = _absent()
    L1: Annotated[Scalar, "m", "linkage length, eq. 11"] = _field(kw_only=True)
    L2: Annotated[Scalar, "m", "linkage length, eq. 11"] = _absent()
    L3: Annotated[Scalar, "m", "linkage length, eq. 11"] = _absent()
    L4: Annotated[Scalar, "m", "linkage length, eq. 11"] = _absent()
    L5: Annotated[Scalar, "m", "linkage length, eq. 12"] = _absent()
    Omega: Annotated[Scalar, "rad/s", "main rotor speed"] = _field(kw_only=True)
    rho: Annotated[Scalar, "kg/m^3", "air density"] = _field(1.2)
    g: Annotated[Scalar, "m/s^2", "gravitational acceleration"] = _field(9.80665)
    # B = 0.97 in eq. 10: the lift ends at 97 % of the blade.
    B: Annotated[Scalar, "1", "tip loss factor"] = _field(0.97)
    m: Annotated[Scalar, "kg", "total mass"] = _absent()
    Iyy: Annotated[Scalar, "kg m^2", "fuselage inertia about the pitch axis"] = _absent()
    Izz: Annotated[Scalar, "kg m^2", "fuselage inertia about the yaw axis"] = _absent()
    Ir: Annotated[Scalar, "kg m^2", "rotor inertia about its shaft"] = _absent()
    Cd0: Annotated[Scalar, "1", "profile drag coefficient of the blade"] = _absent()
    hr: Annotated[Scalar, "m", "rotor disk above the centre of gravity"] = _absent()
    lr: Annotated[Scalar, "m", "rotor axis behind the centre of gravity"] = _absent()
    R_T: Annotated[Scalar, "m", "length of a tail rotor blade"] = _absent()
    c_T: Annotated[Scalar, "m", "tail rotor blade chord"] = _absent()
    a_T: Annotated[Scalar, "1/rad", "tail rotor lift slope"] = _absent()
    L_T: Annotated[Scalar, "m", "tail rotor axis to the centre of gravity"] = _absent()
    # rad/s^2 for a full stick, by eq. 10; the paper's nomenclature states another unit.
    K_throttle: Annotated[Scalar, "rad/s^2", "throttle to rotor acceleration"] = _absent()
    K_theta0: Annotated[Scalar, "rad", "throttle to collective pitch"] = _absent()
    K_theta0T: Annotated[Scalar, "rad", "yaw stick to tail rotor pitch"] = _absent()
    K_Tm: Annotated[Scalar, "N m", "throttle to motor torque"] = _absent()
    K_Omega: Annotated[Scalar, "1", "tail rotor speed over main rotor speed"] = _absent()
    # Extensions of the paper. Zero leaves its equations as printed.
    Sx: Annotated[Scalar, "m^2", "fuselage drag area from ahead, beyond the paper"] = _field(0.0)
    Sy: Annotated[Scalar, "m^2", "fuselage drag area across, beyond the paper"] = _field(0.0)
    Sz: Annotated[Scalar, "m^2", "fuselage drag area from above, beyond the paper"] = _field(0.0)
    Ixx_added: Annotated[Scalar, "kg m^2", "known inertia added to Ixx"] = _field(0.0)
    Iyy_added: Annotated[Scalar, "kg m^2", "known inertia added to Iyy"] = _field(0.0)
    I_beta: Annotated[Scalar, "kg m^2", "blade inertia in flapping"] = _absent()
    k_beta: Annotated[Scalar, "N m/rad", "stiffness of the main rotor's hub"] = _absent()
    # Blade-element theory gives 1; measured vehicles tilt less.
    K_mu: Annotated[Scalar, "1", "speed stability over blade-element theory's"] = _field(1.0)
    h_T: Annotated[Scalar, "m", "tail rotor above the centre of gravity"] = _field(0.0)
    K_P: Annotated[Scalar, "s/rad", "governor: throttle per error of rotor speed"] = _absent()
    K_I: Annotated[Scalar, "1/rad", "governor: throttle rate per error of rotor speed"] = _absent()
    kappa: Annotated[Scalar, "1/s^2", "stand stiffness over own inertia"] = _field(0.0)
    zeta: Annotated[Scalar, "1/s", "stand damping over own inertia"] = _field(0.0)
    # Four times the value of blade-element theory for two blades, averaged over a turn: see
    # `aero.cyclic_moment`.
    cyclic_moment: Annotated[Scalar, "1", "the factor 1/2 of eqs 14-15"] = _field(0.5)
    c_paddle: Annotated[Scalar, "m", "flybar paddle chord; c where not given"] = _absent()
    a_paddle: Annotated[Scalar, "1/rad", "flybar paddle lift slope; a where not given"] = _absent()

    # Local imports, since summaries imports this module.
    def __repr__(self) -> str:
        from heli_jax.summaries import of_vehicle

        return of_vehicle(self)


# A vehicle may lack constants that its model does not read; given constants must be possible. The
# sign of a gain depends on the servo's mounting, that of hr and lr on the rotor's position.
_MAY_BE_NEGATIVE = {"K_theta0T", "K_theta0", "lr", "hr", "h_T", "a_T"}
_MAY_BE_ZERO = {
    "Sx", "Sy", "Sz", "Ixx_added", "Iyy_added", "kappa", "zeta", "Cd0", "g",
    "k_beta", "K_mu", "K_I",
}  # fmt: skip


def of_helicopter(record: type) -> bool:
    """True if a class of parameters has all of Helicopter's, as that of a disturbed model does."""
    return set(naming.names(Helicopter)) <= set(naming.names(record))


def _reasons(params: Mapping[str, Any]) -> Iterator[tuple[Any, str, tuple[Any, ...]]]:
    """Yield the rules for a helicopter's constants: True if broken, and the end of the message.

    Values are numbers or arrays (k,) by name. Missing names are not checked, and values that are
    not numbers pass.
    """
    for name, value in params.items():
        if name in naming.names(Helicopter) and name not in _MAY_BE_NEGATIVE:
            zero = name in _MAY_BE_ZERO
            bound, low = ("zero or more", value < 0) if zero else ("more than zero", value <= 0)
            yield low, f"{name} must be {bound}, got {{:g}}", (value,)
    # Exchanged ends make the flybar's damping negative, and a fit would give an If below 0.
    if {"R1", "R2"} <= params.keys():
        words = (
            "R1 must be less than R2, got R1 = {:g} and R2 = {:g}: R1 is the inner and R2 the "
            "outer end of the flybar paddle (the paper's nomenclature swaps them)"
        )
        yield params["R1"] >= params["R2"], words, (params["R1"], params["R2"])
    if "B" in params:
        yield params["B"] > 1, "B must be a tip loss factor of at most 1, got {:g}", (params["B"],)


def impossible(params: Mapping[str, float]) -> str | None:
    """Return the end of a message on impossible constants; None if all are possible."""
    return next((words.format(*of) for is_so, words, of in _reasons(params) if is_so), None)


def possible(params: Mapping[str, Any]) -> np.ndarray:
    """Return a mask of possible helicopters (k,), from arrays (k,) or numbers by name."""
    # In a sweep an impossible vehicle is a status, not an error.
    values = {n: np.asarray(v) for n, v in params.items()}
    fine = np.asarray(True)
    for is_so, *_ in _reasons(values):
        fine = fine & ~is_so
    return np.asarray(fine)


class Constant(NamedTuple):
    """One constant of a vehicle file, as written."""

    value: float
    """Value in SI."""
    unit: str
    source: str


class Vehicle(NamedTuple):
    """A vehicle file: the parameters and the source of each number."""

    params: Record
    constants: dict[str, Constant]
    path: str


def load_vehicle(path: str | Path, params: type = Helicopter) -> Any:
    """Read a vehicle file into `params` (a Helicopter unless another class is named), in SI.

    Raises:
        InputError: the file or a value in it is wrong; the message names both.
    """
    return read_vehicle(path, params).params


def read_vehicle(
    path: str | Path, params: type = Helicopter, may_lack: Collection[str] = ()
) -> Vehicle:
    """Read a vehicle as `load_vehicle` does, with each constant's unit and source.

    Args:
        may_lack: constants that may be missing; these become NaN.
    """
    return vehicle_from_mapping(read_mapping(path), str(path), params, may_lack)


def vehicle_from_mapping(
    content: Mapping[str, Any],
    where: str,
    params: type = Helicopter,
    may_lack: Collection[str] = (),
) -> Vehicle:
    """Build the parameters from a mapping of names to numbers or {value, unit, source}.

    Args:
        may_lack: constants that may be missing; these become NaN.

    Raises:
        InputError: an unknown name, a missing or an impossible value; the message names `where`.
    """
    known = naming.names(params)
    constants = {}
    require_known(content, known, where, "unknown constant")
    values = {n: e.get("value") if isinstance(e, Mapping) else e for n, e in content.items()}
    stands = [n for n, value in values.items() if value == EDIT]
    if stands:
        requested = ", ".join(f"{n} in {naming.unit(params, n) or '1'}" for n in stands)
        raise InputError(f"{where}: fill in {requested}")
    for name, entry in content.items():
        constants[name] = constant(entry, name, naming.unit(params, name), where)
    lacking = [n for n in known if n not in constants and n not in naming.defaults(params)]
    missing = [n for n in lacking if n not in may_lack]
    if missing:
        raise InputError(f"{where}: {', '.join(missing)} missing, expected a number for each")
    # Limits of a user's own class are unknown.
    values = {n: c.value for n, c in constants.items()}
    if of_helicopter(params) and (wrong := impossible(values)):
        raise InputError(f"{where}: {wrong}")
    # Defaults too, since a derived class has them as plain numbers.
    values = {n: _scalar(v) for n, v in naming.defaults(params).items()}
    values |= {n: _scalar(c.value) for n, c in constants.items()}
    values |= {n: _scalar(math.nan) for n in lacking}
    return Vehicle(params(**values), constants, where)


def constant(entry: Any, name: str, si: str | None, where: str) -> Constant:
    """Return a constant from a number or {value, unit, source}, in SI.

    Args:
        si: its SI unit; None keeps the unit of the file.

    Raises:
        InputError: no finite number, an unknown key, or a unit of another kind.
    """
    place = f"{where}: {name}"
    unit, source = si or "1", ""
    if isinstance(entry, Mapping):
        unknown = [k for k in entry if k not in ("value", "unit", "source")]
        if unknown:
            raise InputError(
                f"{place}: expected the keys value, unit and source, got {unknown[0]!r}"
            )
        if "value" not in entry:
            raise InputError(f"{place}: expected a number under value, got none")
        unit, source = str(entry.get("unit", unit)), str(entry.get("source", ""))
        entry = entry["value"]
    # YAML's true is a bool, and Python's bool is an int.
    if isinstance(entry, bool) or not isinstance(entry, int | float):
        raise InputError(f"{place}: expected a number, got {entry!r:.40}")
    try:
        scale = units.factor(unit, si) if si is not None else 1.0
    except ValueError as e:
        # The unit in the model is wrong, so no change of the file helps.
        if si is not None and units.is_unit(unit) and not units.is_unit(si):
            raise InputError(f"{place}: its unit in the model's Params: {e}") from e
        raise InputError(f"{place}: {e}") from e
    # float() raises OverflowError for integers beyond 1e308.
    value = float(entry) * scale if abs(entry) < 1e300 else math.inf
    if not math.isfinite(value):
        raise InputError(f"{place}: expected a finite number, got {entry!r:.40}")
    return Constant(value, si or unit, source)
