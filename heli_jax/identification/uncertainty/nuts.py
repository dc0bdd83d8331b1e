"""Draws from the posterior by the No-U-Turn sampler (NUTS)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import stages
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.residual import prior_rows, weak_rows
from heli_jax.identification.result import Fit
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
    flight_unknowns,
    unpack,
)

RHAT = 1.01
"""potential scale reduction below which the chains agree (Vehtari et al., 2021)"""
EFFECTIVE = 400
"""effective draws above which an interval is reliable: 100 a chain (Vehtari et al., 2021)"""
_CHAINS = 4
_BLOCKS = 20
"""parts of a chain, for progress"""
_TARGET = 0.8
"""acceptance rate (Hoffman and Gelman, 2014)"""


class Convergence(NamedTuple):
    """Agreement of the chains on one parameter."""

    rhat: float
    """potential scale reduction (Gelman and Rubin); 1 where the chains agree"""
    effective: float
    """effective number of draws"""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws of the free parameters and their convergence."""

    draws: dict[str, np.ndarray]
    """by free parameter, (chains, draws)"""
    convergence: dict[str, Convergence]
    """by free parameter, in the optimiser's coordinates"""
    divergent: int
    nuisance: dict[str, np.ndarray] = field(default_factory=dict)
    """draws of the other unknowns by the names of `Fit.nuisance`, and of 'noise factor OUTPUT'; the
    scale of the noise is integrated out"""
    statistics: dict[str, np.ndarray] = field(default_factory=dict)
    """by draw (chains, draws), by arviz' names: `diverging`, `energy`, `acceptance_rate`, `n_steps`
    (of the integrator), `tree_depth`, `lp` (log density but for a constant), `step_size`"""

    @property
    def rhat(self) -> float:
        """Largest potential scale reduction."""
        return max(c.rhat for c in self.convergence.values())

    @property
    def effective(self) -> float:
        """Smallest effective number of draws."""
        return min(c.effective for c in self.convergence.values())

    @property
    def trusted(self) -> bool:
        """True if the chains converged and are long enough for an interval."""
        return self.rhat < RHAT and self.effective > EFFECTIVE and self.divergent == 0

    def interval(self, name: str) -> tuple[float, float]:
        """Return 2.5 and 97.5 % of the draws."""
        low, high = np.percentile(self.draws[name], [2.5, 97.5])
        return float(low), float(high)


def nuts(fit: Fit, draws: int = 500, *, warmup: int = 200, seed: int = 0) -> Posterior:
    """Return four chains of `draws` draws each, from points near the optimum.

    The prior is flat in the optimiser's coordinates (log of a parameter of one sign) beside the
    priors of the problem; the scale of the noise is integrated out (Jeffreys).

    Args:
        warmup: steps in which step size and mass matrix are adapted.

    Raises:
        ValueError: blackjax is not installed, or the data do not determine every parameter.
    """
    try:
        import blackjax
    except ImportError as e:
        raise ValueError(
            "nuts: blackjax is not installed, expected the extra: pip install 'heli_jax[bayes]'"
        ) from e
    at = fit.reached
    if fit.not_identifiable:
        raise ValueError(f"nuts: the data do not determine {', '.join(fit.not_identifiable)}")
    e = evaluate(at.layout, at.data, at.noise, at.z)
    # Whitened by the Gaussian approximation: with J = QR and z = z0 + R^-1 xi the precision of xi
    # is the unit matrix.
    triangle = np.linalg.qr(np.asarray(e.J, np.float64), mode="r")
    root = jnp.asarray(np.linalg.inv(triangle), at.z.dtype)

    # Jitted here, as blackjax traces it for each of its ten uses.
    @jax.jit
    def density(xi: Array) -> Array:
        return log_posterior(at.layout, at.data, at.noise, at.z + root @ xi)

    forward = jax.custom_vjp(density)

    # Few unknowns and long records: the gradient by forward mode.
    @jax.jit
    def primal(xi: Array) -> tuple[Array, Array]:
        value, push = jax.linearize(density, xi)
        return value, jax.vmap(push)(jnp.eye(xi.shape[0], dtype=xi.dtype))

    forward.defvjp(primal, lambda gradient, ct: (ct * gradient,))

    # blackjax mixes dtypes and ranks where this package would not.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        positions, statistics = _sample(blackjax, forward, at, draws, warmup, seed)
        z = jnp.asarray(at.z + positions @ root.T)
        return _posterior(fit, z, statistics)


def _sample(
    blackjax: ModuleType,
    density: Callable[[Array], Array],
    at: Solution,
    draws: int,
    warmup: int,
    seed: int,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return positions (chains, draws, q) and `Posterior.statistics`."""
    q = at.layout.size
    keys = jax.random.split(jax.random.key(seed), 3)
    adaptation = blackjax.window_adaptation(
        blackjax.nuts, density, target_acceptance_rate=_TARGET, initial_step_size=0.5
    )
    first = 0.1 * jax.random.normal(keys[0], (q,), at.z.dtype)
    run = jax.jit(adaptation.run, static_argnums=2)
    with stages.stage(f"NUTS, warm-up of {warmup} steps"):
        (state, parameters), _ = jax.block_until_ready(run(keys[1], first, warmup))
    sampler = blackjax.nuts(density, **parameters)
    # Chains begin apart: R-hat compares them.
    settling = warmup // 2

    # The states are blackjax's own records: `Any`.
    def begin(key: Array) -> Any:
        return sampler.init(state.position + 0.5 * jax.random.normal(key, (q,), at.z.dtype))

    def step(state: Any, key: Array) -> tuple[Any, tuple[Array, dict[str, Array]]]:
        state, info = sampler.step(key, state)
        statistics = {
            "diverging": info.is_divergent,
            "energy": info.energy,
            "acceptance_rate": info.acceptance_rate,
            "n_steps": info.num_integration_steps,
            "tree_depth": info.num_trajectory_expansions,
            "lp": state.logdensity,
        }
        return state, (state.position, statistics)

    pairs = jax.vmap(jax.random.split)(jax.random.split(keys[2], _CHAINS))
    chains = jax.jit(jax.vmap(begin))(pairs[:, 0])
    # Some steps at a time, to report progress; more than `count` are left out.
    count = draws + settling
    block = -(-count // _BLOCKS)
    split = jax.vmap(lambda key: jax.random.split(key, block * _BLOCKS))(pairs[:, 1])
    some = jax.jit(jax.vmap(lambda state, keys: jax.lax.scan(step, state, keys)))
    chunks = []
    with stages.stage(f"NUTS, {_CHAINS} chains", total=count):
        for i in range(0, count, block):
            chains, drawn = some(chains, split[:, i : i + block])
            chunks.append(jax.device_get(drawn))
            stages.advance(min(block, count - i))
    positions, statistics = jax.tree.map(
        lambda *v: np.concatenate(v, axis=1)[:, settling:count], *chunks
    )
    size = np.broadcast_to(np.asarray(parameters["step_size"]), statistics["lp"].shape)
    return positions, {**statistics, "step_size": size}


def _posterior(
    fit: Fit, z: Float[Array, "chains draws q"], statistics: dict[str, np.ndarray]
) -> Posterior:
    """Return the draws of all unknowns by the names that a fit gives them, SI."""
    from blackjax import diagnostics

    layout, data = fit.reached.layout, fit.reached.data
    unpacked = jax.jit(lambda data, z: jax.vmap(jax.vmap(lambda z: unpack(layout, data, z)))(z))
    u: Unknowns = jax.tree.map(np.asarray, unpacked(data, z))
    nuisance = {f"gain {name}": v for name, v in u.gains.items()}
    if layout.shift:
        nuisance["time_shift"] = u.shift
    nuisance |= {name: u.noise[name] for name in layout.noises}
    nuisance |= {f"noise factor {name}": u.scales[name] for name in layout.scaled}
    fitted = [s.flight for s in fit.signals if not s.hold_out]
    for i, one in enumerate(flight_unknowns(layout, fitted), layout.first_nuisance):
        nuisance[one.label] = np.asarray(z[..., i]) * one.scale(data)
    # In the optimiser's coordinates the posterior is nearest to a normal distribution.
    named = z[:, :, : len(layout.free)]
    rhat = np.asarray(jax.jit(diagnostics.potential_scale_reduction)(named))
    effective = np.asarray(jax.jit(diagnostics.effective_sample_size)(named))
    agreed = [Convergence(float(r), float(n)) for r, n in zip(rhat, effective, strict=True)]
    return Posterior(
        {name: np.asarray(u.params[name]) for name in layout.free},
        dict(zip(layout.free, agreed, strict=True)),
        int(np.sum(statistics["diverging"])),
        {name: np.asarray(v) for name, v in nuisance.items()},
        statistics,
    )


def log_posterior(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> Float[Array, ""]:
    """Return the log density of z but for a constant.

    With output error the noise scale of each flight and output is integrated out under Jeffreys'
    prior. With filter error z holds the logarithms of all noises, each with a flat prior.
    """
    # Draws integrate over the parameters of the mean, which the restricted likelihood allows for.
    scales = layout.model.input_scales
    corrections = {n: c for n, c in dict(noise.corrections).items() if n in scales}
    noise = noise._replace(corrections=corrections)
    residuals = layout.objective.residuals(layout, data, noise, unpack(layout, data, z))
    rest = jnp.concatenate([prior_rows(layout, data, z), weak_rows(layout, z)])
    # The scale of the priors' rows is known.
    measured = layout.objective.log_density(layout, data, residuals)
    return measured - 0.5 * jnp.sum(rest**2)
