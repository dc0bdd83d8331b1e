"""Free: a parameter to be estimated, and what makes no sense of one."""

import math
from typing import Literal, NamedTuple

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.errors import nearest


class Prior(NamedTuple):
    """What is known of a parameter beforehand: a normal distribution, in the parameter's unit."""

    mean: float
    sd: float


Sign = Literal["keep", "any"]


class Free(NamedTuple):
    """A parameter to be estimated: where to start, between what bounds, with what prior.

    `sign` says whether the estimate may have another sign than the start: `keep` (searched in its
    logarithm) or `any` (searched in units of its start, which may then be zero). Unless given, a
    Helicopter's parameters keep theirs, and so do those that `Model.positive` names; others of a
    model of one's own may have any. Bounds that lie on one side of zero keep it in either case.
    """

    start: float = math.nan
    """the initial guess; NaN where none is stated, and one has to be found before a Problem is made
    (`equation_error_start`)"""
    lower: float | None = None
    upper: float | None = None
    prior: Prior | None = None
    sign: Sign | None = None


def check_free(name: str, free: Free, model: Model) -> None:
    """Refuse a free parameter that the model does not have, or whose numbers contradict.

    Args:
        name: of the parameter.
        free: its start, bounds, prior and sign; the sign is filled in.
        model: whose Params it belongs to.

    Raises:
        ValueError: naming the key, what was expected and what was got.
    """
    if name not in naming.names(model.Params):
        known = naming.names(model.Params)
        raise ValueError(
            f"free.{name}: model {model.name} has no such parameter{nearest(name, known)}"
        )
    if math.isnan(free.start):
        raise ValueError(
            f"free.{name}.start: missing, expected a number to begin with (or, for a linear model, "
            "start: equation-error, which finds one)"
        )
    numbers = {"start": free.start, "lower": free.lower, "upper": free.upper}
    if free.prior is not None:
        numbers |= {"prior.mean": free.prior.mean, "prior.sd": free.prior.sd}
    for key, value in numbers.items():
        if value is not None and not math.isfinite(value):
            raise ValueError(f"free.{name}.{key}: expected a finite number, got {value}")
    if free.prior is not None and free.prior.sd <= 0:
        raise ValueError(f"free.{name}.prior.sd must be above zero, got {free.prior.sd:g}")
    # None is no answer any more: the Problem has filled it in by the kind of model.
    if free.sign not in ("keep", "any"):
        raise ValueError(f"free.{name}.sign: expected 'keep' or 'any', got {free.sign!r}")
    if name in model.positive:
        _check_positive(name, free)
    _check_bounds(name, free)


def _check_bounds(name: str, free: Free) -> None:
    low, high = free.lower, free.upper
    if free.sign == "keep" and low is not None and high is not None and low < 0 < high:
        raise ValueError(
            f"free.{name}.sign: keep: expected bounds of one sign, got {low:g} to {high:g}"
        )
    if low is not None and high is not None and low >= high:
        raise ValueError(f"free.{name}: lower must be below upper, got {low:g} and {high:g}")
    # Not on a bound either: in the coordinates of a bounded parameter its ends are at infinity.
    if (low is not None and free.start <= low) or (high is not None and free.start >= high):
        shown = (
            f"{'-inf' if low is None else f'{low:g}'} to {'inf' if high is None else f'{high:g}'}"
        )
        raise ValueError(f"free.{name}.start: expected a value inside {shown}, got {free.start:g}")
    # Zero has no logarithm; between two bounds the search is in another coordinate.
    if free.start == 0 and free.sign == "keep" and (low is None or high is None):
        raise ValueError(
            f"free.{name}.start: expected a start of the right sign and size, or lower and upper, "
            "or sign: any; got 0 without two bounds"
        )


def _check_positive(name: str, free: Free) -> None:
    """Refuse what would let a parameter be zero or less that the model says is positive."""
    for key, value in (("start", free.start), ("lower", free.lower)):
        # Zero will do as a lower bound, which is open, and not as a start, which has no logarithm.
        if value is not None and (value < 0 or (key == "start" and value == 0)):
            raise ValueError(
                f"free.{name}.{key}: expected more than zero, since the model says that it is "
                f"positive, got {value:g}"
            )
    if free.sign == "any":
        raise ValueError(
            f"free.{name}.sign: expected keep, since the model says that it is positive, got any"
        )
