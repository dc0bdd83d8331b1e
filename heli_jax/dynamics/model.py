"""Model: how dynamics, ours or anyone's, reach simulation, identification and report."""

import copy
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax import naming


class Model(eqx.Module):
    r"""Pure dynamics $\dot x = f(p, x, u)$, $y = h(p, x, u)$ of one machine, with named parts.

    `Params`, `State`, `Inputs` and `Outputs` are classes built by keyword with one scalar a field
    (an `eqx.Module` or a `NamedTuple`; see `heli_jax.naming` for units). `vector_field` returns a
    `State` of derivatives per second. Nothing here knows about batches: use `jax.vmap`.

    `linear=True` says that `vector_field` and `output` are linear in (state, inputs) and vanish
    where both do; the exact zero-order-hold discretisation may then be used, with matrices taken
    by differentiation.
    """

    name: str = eqx.field(static=True)
    vector_field: Callable[[Any, Any, Any], Any] = eqx.field(static=True)
    output: Callable[[Any, Any, Any], Any] = eqx.field(static=True)
    Params: type = eqx.field(static=True)
    State: type = eqx.field(static=True)
    Inputs: type = eqx.field(static=True)
    Outputs: type = eqx.field(static=True)
    linear: bool = eqx.field(static=True, default=False)
    start: Callable[[Any], Any] | None = eqx.field(static=True, default=None)
    noise: Callable[[Any], Any] | None = eqx.field(static=True, default=None)
    """noise(params): a State of white-noise intensities, 1 over sqrt(s) times the state's rate"""
    spread: Callable[[Any], dict[str, Any]] | None = eqx.field(static=True, default=None)
    """spread(params): standard deviation at the first sample of the states that are random there,
    by name; the others begin where `start` puts them"""
    correlation: Callable[[Any], dict[tuple[str, str], Any]] | None = eqx.field(
        static=True, default=None
    )
    """correlation(params): at the first sample, between two of the states that `spread` names, by
    pair of names; what is not named is uncorrelated"""
    limits: Callable[[Any, Any, Any], dict[str, Any]] | None = eqx.field(static=True, default=None)
    """limits(params, state, inputs): by name, whether the range of validity is left there"""

    @property
    def spread_names(self) -> tuple[str, ...]:
        """The states that are random at the first sample."""
        if self.spread is None:
            return ()
        return tuple(self.spread(self.Params(**dict.fromkeys(naming.names(self.Params), 1.0))))

    def initial_state(self, params: Any) -> Any:
        """The state at the first sample: `start(params)`, or all zeros."""
        if self.start is not None:
            return self.start(params)
        return zeros(self.State)


def zeros(record: type, dtype: Any = None) -> Any:
    """A record of scalar zeros of the default float type (or `dtype`)."""
    dtype = jnp.result_type(float) if dtype is None else dtype
    return record(**{name: jnp.zeros((), dtype) for name in naming.names(record)})


def spread_of(model: Model, params: Any, dtype: Any) -> Array:
    """The standard deviations (n,) of all states at the first sample; zero where not random."""
    given = model.spread(params) if model.spread is not None else {}
    values = [given.get(n, 0.0) for n in naming.names(model.State)]
    return jnp.stack([jnp.asarray(v, dtype) for v in values])


def correlation_of(model: Model, params: Any, dtype: Any) -> Array:
    """The correlation matrix (n, n) of all states at the first sample.

    Raises:
        ValueError: the model correlates a state that is not random there.
    """
    names, random = naming.names(model.State), model.spread_names
    matrix = jnp.eye(len(names), dtype=dtype)
    pairs = model.correlation(params) if model.correlation is not None else {}
    for pair, value in pairs.items():
        if not set(pair) <= set(random):
            raise ValueError(
                f"model {model.name}: correlation of {' and '.join(pair)}: expected two of the "
                f"states that spread names ({', '.join(random) or 'none'})"
            )
        i, j = (names.index(n) for n in pair)
        value = jnp.asarray(value, dtype)
        matrix = matrix.at[i, j].set(value).at[j, i].set(value)
    return matrix


def linear_misfit(model: Model, params: Any) -> float:
    """How far a model is from `linear=True`: 0 where f(x, u) and h(x, u) are linear, else ~1.

    Compares f and h at two states with the sum of both, relative to their size. Concrete
    parameters only.
    """
    rng = np.random.default_rng(7)

    def draw(record: type) -> Any:
        return record(**{n: np.float64(rng.standard_normal()) for n in naming.names(record)})

    def both(state: Any, inputs: Any) -> np.ndarray:
        with np.errstate(all="ignore"):
            rates, outputs = field_and_output(model, params, state, inputs)
        return np.array([float(v) for v in jax.tree.leaves((rates, outputs))])

    params = plain(params)
    x1, x2, u1, u2 = draw(model.State), draw(model.State), draw(model.Inputs), draw(model.Inputs)
    with np.errstate(all="ignore"):
        summed = both(jax.tree.map(np.add, x1, x2), jax.tree.map(np.add, u1, u2))
        parts = both(x1, u1) + both(x2, u2)
        size = np.max(np.abs(summed)) + np.max(np.abs(parts))
        return float(np.max(np.abs(summed - parts)) / max(size, 1e-300))


def field_and_output(model: Model, params: Any, state: Any, inputs: Any) -> tuple[Any, Any]:
    """The model's rates and outputs at one point."""
    return (
        model.vector_field(params, state, inputs),
        model.output(params, state, inputs),
    )


def plain(record: Any, **changes: Any) -> Any:
    """A record of concrete numbers, some of them changed, as NumPy scalars: quicker than JAX
    outside jit."""
    values = {n: np.float64(v) for n, v in {**naming.asdict(record), **changes}.items()}
    if isinstance(record, tuple):
        return type(record)(**values)
    # Past the class, which may make arrays of them (Helicopter does).
    made = copy.copy(record)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def needed_but_missing(model: Model, params: Any) -> list[str]:
    """The parameters that are NaN (not given) and that the model reads, in field order."""
    params = plain(params)
    open_ = [n for n, v in naming.asdict(params).items() if np.isnan(v)]
    return [n for n in open_ if np.isnan(_at_one(model, params, n, np.nan)).any()]


def reads(model: Model, params: Any, name: str) -> bool:
    """Whether the rates or the outputs depend on a parameter, where states and inputs are one."""
    if np.isnan(_at_one(model, params, name, np.nan)).any():
        return True
    # One that may be left out has another in its place where it is NaN.
    given, larger = (_at_one(model, params, name, value) for value in (1.0, 2.0))
    return not np.array_equal(given, larger, equal_nan=True)


def _at_one(model: Model, params: Any, name: str, value: float) -> np.ndarray:
    """Rates and outputs where states, inputs and what is not given are one, and a parameter is
    `value`."""
    one = np.float64(1.0)
    others = {n: one for n, v in naming.asdict(params).items() if np.isnan(v)}
    filled = plain(params, **{**others, name: value})
    x = model.State(**dict.fromkeys(naming.names(model.State), one))
    u = model.Inputs(**dict.fromkeys(naming.names(model.Inputs), one))
    with np.errstate(all="ignore"):
        parts = field_and_output(model, filled, x, u)
    return np.array([float(v) for v in jax.tree.leaves(parts)])
