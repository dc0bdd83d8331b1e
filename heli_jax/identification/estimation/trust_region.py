"""optimistix's Levenberg-Marquardt with a trust region that opens faster and knows rounding."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

# Annotated Any: what optimistix hands from step to step, records of its own without public names.

_ROUNDING = 1e-12
"""Part of the sum of squares below which a change is rounding."""


class _TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's trust region, but a step whose gain would drown in rounding is accepted.

    Otherwise such a step, which is the last, is rejected at random and the search lingers.
    """

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Float[Array, " q"],
        y_eval: Float[Array, " q"],
        f_info: Any,
        f_eval_info: Any,
        state: Any,
    ) -> Any:
        """As optimistix: the next step size, whether the step counts, and two records of its own.

        Args:
            first_step: whether nothing has been tried yet.
            y: the unknowns at the last point that was accepted.
            y_eval: the unknowns at the point that is judged.
            f_info, f_eval_info: residuals and Jacobian at each.
            state: the step size so far.
        """
        size, accept, result, new = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        cost = f_info.as_min()
        gain = self.predict_reduction(y_eval - y, f_info)
        change = f_eval_info.as_min() - cost
        # Both: a small predicted gain alone would also let a step pass that raises the cost.
        negligible = (gain > -_ROUNDING * cost) & (change < _ROUNDING * cost)
        return size, accept | negligible, result, new


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's Levenberg-Marquardt with a trust region that opens faster.

    The default waits for an all but perfect model (ratio 0.99) before it lowers the damping.
    """

    rtol: float
    atol: Float[Array, "..."]
    norm: Callable[[Array], Array]
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable[..., None]

    def __init__(
        self, rtol: float, atol: Float[Array, "..."], convergence_mask: Bool[Array, " q"]
    ) -> None:
        """With the tolerances below whose sum a change is the last.

        Args:
            rtol: relative to the unknown, or to the size of the residuals.
            atol: in the optimiser's units.
            convergence_mask: the unknowns whose changes count.
        """
        self.rtol, self.atol = rtol, atol
        self.norm = _norm(convergence_mask)
        # QR of the rows and not Cholesky of J'J, whose condition number is the square of theirs.
        self.descent = optx.DampedNewtonDescent(linear_solver=lx.QR())
        # A hundred times the region where three quarters of the gain came that was predicted
        # (optimistix: 3.5 times): the damping of 1 to begin with is gone within a few steps.
        self.search = _TrustRegion(
            high_cutoff=0.75, low_cutoff=0.1, high_constant=100.0, low_constant=0.1
        )
        self.verbose = lambda **_: None


def within_reach(
    state: Any, y: Float[Array, " q"], reach: Float[Array, " q"], unit: Float[Array, " q"]
) -> Any:
    """The solver's state, its next point no further from y than `reach` in each unknown by itself.

    A bound on the whole step would let one unknown that runs away stop all others.

    Args:
        state: after a step.
        y: the unknowns at the last point that was accepted.
        reach: by unknown, inf where there is no bound.
        unit: of the unknowns y, in which reach is not given; 0 where one stays put.
    """
    reach = reach / jnp.where(unit > 0, unit, 1.0)
    # In each unknown by itself: the others go as far as they wanted, and the direction is bent
    # rather than shortened.
    nearer = jnp.clip(state.y_eval, y - reach, y + reach)
    return eqx.tree_at(lambda s: s.y_eval, state, nearer)


def _norm(convergence_mask: Bool[Array, " q"]) -> Callable[[Array], Array]:
    def norm(x: Array) -> Array:
        # optimistix asks once with the q unknowns and once with the 2 q + 1 rows; their shape
        # tells which. Of the rows the first is the size of the residuals, see `_compressed`.
        unknowns = x.shape == convergence_mask.shape
        return optx.max_norm(jnp.where(convergence_mask, x, 0.0) if unknowns else x[0])

    return norm
