"""Tables of the recursive least squares: what it found, and how that compares with the fit."""

import math

import numpy as np

from heli_jax import naming
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.result import Fit
from heli_jax.numbers import NOTHING, number, percent, with_sd
from heli_jax.report.tables.table import NOT_DETERMINED, Table


def baseline_ratios(fit: Fit, baseline: Baseline) -> Table:
    """a/Ixx and the like: as the RLS has them and as the fit has them."""
    rows = []
    for name, value in baseline.combinations.items():
        estimate = _ratio(fit, name)
        if estimate is None:
            rows.append((name, number(value), NOT_DETERMINED, NOTHING))
            continue
        mean, sd = estimate
        off = percent(value / mean - 1.0, 1) if mean else NOTHING
        rows.append((name, number(value), with_sd(mean, sd) if sd > 0 else number(mean, 6), off))
    return Table(("ratio", "RLS", "fit", "RLS against fit"), rows)


def _ratio(fit: Fit, name: str) -> tuple[float, float] | None:
    """Value and sd of `x/y` by the fit; None where it is not determined or not of the model."""
    # A ratio may be determined where neither of its two is: those come with an sd of their own.
    for c in fit.verdict.combinations:
        if c.name == name:
            return c.value, c.sd
    over, _, under = name.partition("/")
    parameters = naming.names(type(fit.params))
    if over not in parameters or under not in parameters:
        return None
    value = float(getattr(fit.params, over)) / float(getattr(fit.params, under))
    v = fit.verdict
    # log(x/y) = log x - log y; what is fixed has no weight, for it has no sd.
    # The sd of a ratio takes the correlation of its two: a and Ixx may both be vague where a/Ixx is
    # sharp.
    weights = np.array([(n == over) - float(n == under) for n in v.names])
    missing = {*v.undetermined, *v.without_effect}
    if any(w and n in missing for w, n in zip(weights, v.names, strict=True)):
        return None
    sds = np.array([_relative_sd(fit, n) for n in v.names]) * weights
    # To first order; rounding may leave the variance of two that are fully correlated below zero.
    return value, abs(value) * math.sqrt(max(0.0, float(sds @ v.correlation @ sds)))


def _relative_sd(fit: Fit, name: str) -> float:
    e = fit.estimates.get(name)
    return e.sd / abs(e.value) if e is not None and e.sd is not None and e.value else 0.0


def baseline_facts(b: Baseline) -> Table:
    """What the recursive least squares found, in full."""
    # The slowest first, and conjugates side by side.
    poles = [_complex(p) for p in sorted(b.poles, key=lambda p: (-abs(p), p.imag))]
    rows = [
        ("from, to", f"{b.input} to {b.output}, {b.flight}"),
        ("order, forgetting", f"{b.order}, {b.forgetting:g}"),
        ("coefficients −a", _polynomial(b.theta[: b.order])),
        ("coefficients b", _polynomial(b.theta[b.order :])),
        ("poles of Hd(z)", ";  ".join(poles)),
    ]
    if b.continuous_num is not None and b.continuous_den is not None:
        kind = "exact inverse of the hold" if b.exact else "not exact"
        rows += [
            (f"H(s), numerator ({kind})", _polynomial(b.continuous_num)),
            (f"H(s), denominator ({kind})", _polynomial(b.continuous_den)),
        ]
    else:
        rows.append(("H(s)", "none"))
    return Table(("", "highest power first"), rows)


def _polynomial(c: np.ndarray) -> str:
    return ",  ".join(number(float(x), 6) for x in c)


def _complex(p: complex) -> str:
    size = f"size {abs(p):.4f}"
    if abs(p.imag) < 1e-12:
        return f"{number(p.real, 5)} ({size})"
    sign = "+" if p.imag > 0 else "−"
    return f"{number(p.real, 5)} {sign} {number(abs(p.imag), 5)}i ({size})"
