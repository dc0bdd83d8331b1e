"""Helicopter: every constant of the paper's nomenclature, in SI.

Symbols are those of Kim & Tilbury (1997), appendix; `R1` is the inner and `R2` the outer end of
the flybar paddle (the paper's nomenclature exchanges the two, which would make the flybar's
damping negative).
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
    """Python and NumPy numbers become arrays of the default float; anything else passes."""
    # Tracers, batches and the placeholders of JAX's tree functions are left as they are: a pytree's
    # class has to build from whatever its leaves have become.
    if isinstance(value, (bool, int, float, np.floating, np.integer)):
        return jnp.asarray(value, dtype=jnp.result_type(float))
    return value


# Any, since a field's default stands where the class says Scalar.
def _field(default: float | None = None, *, kw_only: bool = False) -> Any:
    if default is None:
        return eqx.field(converter=_scalar, kw_only=kw_only)
    return eqx.field(converter=_scalar, default=default)


def _absent() -> Any:
    return _field(math.nan)


class Helicopter(eqx.Module):
    """A single-rotor helicopter with a Bell-Hiller flybar; every field a scalar in SI.

    A field that is NaN is not given: models that read it refuse the vehicle. `c_paddle` and
    `a_paddle` are the exception: where they are not given the paddle has the blade's chord and
    lift slope, as in the paper, and an If that is found is larger than one that was swung by
    a c / (a_paddle c_paddle).
    """

    # What the reduced roll model reads has no default; what only the whole helicopter reads is NaN
    # until it is given, and `needed_but_missing` says so.
    Ixx: Annotated[Scalar, "kg m^2", "fuselage inertia about the roll axis"] = _field()
    If: Annotated[Scalar, "kg m^2", "flybar inertia in flapping"] = _absent()
    R: Annotated[Scalar, "m", "length of a main rotor blade"] = _field(kw_only=True)
    c: Annotated[Scalar, "m", "main rotor blade chord"] = _field(kw_only=True)
    a: Annotated[Scalar, "1/rad", "main rotor lift slope"] = _field(kw_only=True)
    # What a vehicle without a flybar has not.
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
    # Eq. 10's B = 0.97: lift ends at 97 % of the blade.
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
    # rad/s^2 for a full stick, by eq. 10; the paper's nomenclature says another unit.
    K_throttle: Annotated[Scalar, "rad/s^2", "throttle to rotor acceleration"] = _absent()
    K_theta0: Annotated[Scalar, "rad", "throttle to collective pitch"] = _absent()
    K_theta0T: Annotated[Scalar, "rad", "yaw stick to tail rotor pitch"] = _absent()
    K_Tm: Annotated[Scalar, "N m", "throttle to motor torque"] = _absent()
    K_Omega: Annotated[Scalar, "1", "tail rotor speed over main rotor speed"] = _absent()
    # Beyond the paper from here on: zero leaves its equations as they are printed.
    Sx: Annotated[Scalar, "m^2", "fuselage drag area from ahead, beyond the paper"] = _field(0.0)
    Sy: Annotated[Scalar, "m^2", "fuselage drag area across, beyond the paper"] = _field(0.0)
    Sz: Annotated[Scalar, "m^2", "fuselage drag area from above, beyond the paper"] = _field(0.0)
    Ixx_added: Annotated[Scalar, "kg m^2", "known inertia added to Ixx"] = _field(0.0)
    Iyy_added: Annotated[Scalar, "kg m^2", "known inertia added to Iyy"] = _field(0.0)
    I_beta: Annotated[Scalar, "kg m^2", "blade inertia in flapping"] = _absent()
    k_beta: Annotated[Scalar, "N m/rad", "stiffness of the main rotor's hub"] = _absent()
    # Blade-element theory has 1; measured vehicles tilt less.
    K_mu: Annotated[Scalar, "1", "speed stability over blade-element theory's"] = _field(1.0)
    h_T: Annotated[Scalar, "m", "tail rotor above the centre of gravity"] = _field(0.0)
    K_P: Annotated[Scalar, "s/rad", "governor: throttle per error of rotor speed"] = _absent()
    K_I: Annotated[Scalar, "1/rad", "governor: throttle rate per error of rotor speed"] = _absent()
    kappa: Annotated[Scalar, "1/s^2", "stand stiffness over own inertia"] = _field(0.0)
    zeta: Annotated[Scalar, "1/s", "stand damping over own inertia"] = _field(0.0)
    # Four times what blade-element theory gives for two blades over a turn: see
    # `aero.cyclic_moment`.
    cyclic_moment: Annotated[Scalar, "1", "the factor 1/2 of eqs 14-15"] = _field(0.5)
    c_paddle: Annotated[Scalar, "m", "flybar paddle chord; c where not given"] = _absent()
    a_paddle: Annotated[Scalar, "1/rad", "flybar paddle lift slope; a where not given"] = _absent()

    # Imported where they are used: summaries import this module.
    def __repr__(self) -> str:
        from heli_jax.summaries import as_text, of_vehicle

        return as_text(of_vehicle(self))

    def _repr_html_(self) -> str:
        from heli_jax.summaries import as_html, of_vehicle

        return as_html(of_vehicle(self))


# A vehicle may leave out what the model at hand does not read; what it gives must be possible.
# Gains have the sign of how a servo is mounted, and hr and lr that of where a rotor stands.
_MAY_BE_NEGATIVE = {"K_theta0T", "K_theta0", "lr", "hr", "h_T", "a_T"}
_MAY_BE_ZERO = {
    "Sx", "Sy", "Sz", "Ixx_added", "Iyy_added", "kappa", "zeta", "Cd0", "g",
    "k_beta", "K_mu", "K_I",
}  # fmt: skip


def of_helicopter(record: type) -> bool:
    """True if a class of parameters has all of Helicopter's, as that of a disturbed model has."""
    return set(naming.names(Helicopter)) <= set(naming.names(record))


def _reasons(params: Mapping[str, Any]) -> Iterator[tuple[Any, str, tuple[Any, ...]]]:
    """Return the rules for a helicopter's constants: whether each is broken, and the end of its
    sentence. Values are numbers or arrays (k,) by name; a name that is missing is not checked, and
    a value that is not a number passes."""
    for name, value in params.items():
        if name in naming.names(Helicopter) and name not in _MAY_BE_NEGATIVE:
            zero = name in _MAY_BE_ZERO
            bound, low = ("zero or more", value < 0) if zero else ("more than zero", value <= 0)
            yield low, f"{name} must be {bound}, got {{:g}}", (value,)
    # Exchanged ends would make the flybar's damping negative, and a fit would end in an If below 0.
    if {"R1", "R2"} <= params.keys():
        words = (
            "R1 must be less than R2, got R1 = {:g} and R2 = {:g}: R1 is the inner and R2 the "
            "outer end of the flybar paddle (the paper's nomenclature exchanges them)"
        )
        yield params["R1"] >= params["R2"], words, (params["R1"], params["R2"])
    if "B" in params:
        yield params["B"] > 1, "B must be a tip loss factor of at most 1, got {:g}", (params["B"],)


def impossible(params: Mapping[str, float]) -> str | None:
    """Return the end of a sentence on constants that are impossible; None if all are possible."""
    return next((words.format(*of) for is_so, words, of in _reasons(params) if is_so), None)


def possible(params: Mapping[str, Any]) -> np.ndarray:
    """Return which helicopters are possible (k,), from arrays (k,) or numbers by name."""
    # For a batch of a sweep: what cannot be is a status there, not an error.
    values = {n: np.asarray(v) for n, v in params.items()}
    fine = np.asarray(True)
    for is_so, *_ in _reasons(values):
        fine = fine & ~is_so
    return np.asarray(fine)


class Constant(NamedTuple):
    """One constant of a vehicle file as it was written."""

    value: float
    """in SI"""
    unit: str
    source: str


class Vehicle(NamedTuple):
    """A vehicle file: the parameters, and where each number comes from."""

    params: Record
    constants: dict[str, Constant]
    path: str


def load_vehicle(path: str | Path, params: type = Helicopter) -> Any:
    """Read a vehicle file into `params` (a Helicopter unless another class is named), in SI.

    Raises:
        InputError: the file or a value in it is wrong; the sentence names both.
    """
    return read_vehicle(path, params).params


def read_vehicle(
    path: str | Path, params: type = Helicopter, may_lack: Collection[str] = ()
) -> Vehicle:
    """Read a vehicle as `load_vehicle` does, with each constant's unit and source.

    Args:
        may_lack: constants that may be missing, and are NaN then.
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
        may_lack: constants that may be missing, and are NaN then.

    Raises:
        InputError: an unknown name, a missing or an impossible value; `where` is named.
    """
    known = naming.names(params)
    constants = {}
    require_known(content, known, where, "unknown constant")
    values = {n: e.get("value") if isinstance(e, Mapping) else e for n, e in content.items()}
    stands = [n for n, value in values.items() if value == EDIT]
    if stands:
        asked = ", ".join(f"{n} in {naming.unit(params, n) or '1'}" for n in stands)
        raise InputError(f"{where}: is still {EDIT}, expected numbers of {asked}")
    for name, entry in content.items():
        constants[name] = constant(entry, name, naming.unit(params, name), where)
    lacking = [n for n in known if n not in constants and n not in naming.defaults(params)]
    missing = [n for n in lacking if n not in may_lack]
    if missing:
        raise InputError(f"{where}: {', '.join(missing)} missing, expected a number for each")
    # Of a class of one's own nobody knows what is possible.
    values = {n: c.value for n, c in constants.items()}
    if of_helicopter(params) and (wrong := impossible(values)):
        raise InputError(f"{where}: {wrong}")
    # Defaults too: a class that devices extend has them as plain numbers.
    values = {n: _scalar(v) for n, v in naming.defaults(params).items()}
    values |= {n: _scalar(c.value) for n, c in constants.items()}
    values |= {n: _scalar(math.nan) for n in lacking}
    return Vehicle(params(**values), constants, where)


def constant(entry: Any, name: str, si: str | None, where: str) -> Constant:
    """A number of a file, or {value, unit, source}, in SI.

    Args:
        si: its SI unit; None where it has none, and the file's is taken as it is.

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
    # YAML's true is a bool, which Python counts among the integers.
    if isinstance(entry, bool) or not isinstance(entry, int | float):
        raise InputError(f"{place}: expected a number, got {entry!r:.40}")
    try:
        scale = units.factor(unit, si) if si is not None else 1.0
    except ValueError as e:
        # The file's own unit is right, and that of the model is not: no change of the file helps.
        if si is not None and units.is_unit(unit) and not units.is_unit(si):
            raise InputError(f"{place}: its unit in the model's Params: {e}") from e
        raise InputError(f"{place}: {e}") from e
    # An integer past 1e308 cannot become a float: OverflowError would be the message.
    value = float(entry) * scale if abs(entry) < 1e300 else math.inf
    if not math.isfinite(value):
        raise InputError(f"{place}: expected a finite number, got {entry!r:.40}")
    return Constant(value, si or unit, source)
