"""optimistix's Levenberg-Marquardt with a trust region that opens faster and knows rounding."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

# Annotated Any: what optimistix hands from step to step, records of its own without public names.

_ROUNDING = 1e-12
"""Part of the sum of squares below which a change is rounding."""


_GROWTH = 3.0
"""times the change of the residuals by a step that did as predicted may the next one make"""
ARRIVED = 1e-4
"""of joint standard deviations, squared: no interval shows a hundredth of one, and steps that
shrink by a fifth each take ten more to come to a thousandth"""


class Nearing(NamedTuple):
    """How a search ends after which the noise is estimated anew, and another one begins."""

    unchecked: float
    """gain in joint standard deviations squared below which a whole step is the last, taken without
    an evaluation of where it leads: the next search begins with that"""
    damping: float = 1.0
    """of the first step, in the optimiser's units: little near an optimum"""


class _Region(NamedTuple):
    """How far to go next."""

    step_size: Float[Array, ""]
    """one over the damping"""
    radius: Float[Array, ""]
    """by how much the residuals may change; inf as long as no step was refused"""


class _TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's trust region, but a step whose gain would drown in rounding is accepted, and
    after one that is refused there is a radius as well as more damping.

    Otherwise a step of negligible gain, which is the last, is rejected at random and the search
    lingers. Damping alone does nothing until it comes to the size of what the data say: a search
    that goes well has next to none, and tenfold of that would try a refused step again, time after
    time. The radius is of the residuals' change, which directions that the data leave open do not
    make.
    """

    def init(self, y: Float[Array, " q"], f_info_struct: Any) -> Any:
        """As optimistix: a `_Region` without a radius.

        Args:
            y: the unknowns.
            f_info_struct: shapes of residuals and Jacobian.
        """
        begin = super().init(y, f_info_struct)
        return _Region(begin.step_size, jnp.asarray(jnp.inf, y.dtype))

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
        size, accept, result, _ = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        cost = f_info.as_min()
        gain = self.predict_reduction(y_eval - y, f_info)
        change = f_eval_info.as_min() - cost
        # Both: a small predicted gain alone would also let a step pass that raises the cost.
        negligible = (gain > -_ROUNDING * cost) & (change < _ROUNDING * cost)
        accept |= negligible
        moved = f_info.jac.mv(y_eval - y)
        slope = jnp.sum(f_info.residual * moved)
        # Where the parabola by slope and cost is lowest, within a tenth and a half (More, 1978).
        part = -slope / (2.0 * (change - slope))
        part = jnp.where(jnp.isfinite(part), jnp.clip(part, 0.1, 0.5), 0.1)
        grown = jnp.where(change < self.high_cutoff * gain, _GROWTH * _norm2(moved), 0.0)
        radius = jnp.where(accept, jnp.maximum(state.radius, grown), part * _norm2(moved))
        return size, accept, result, _Region(size, radius)


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


def within_radius(state: Any, y: Float[Array, " q"], limited: Bool[Array, ""] | bool = True) -> Any:
    """The solver's state, its next point no further from y than its radius.

    Args:
        state: after a step.
        y: the unknowns at the last point that was accepted.
        limited: whether there is to be a radius at all.
    """
    step = state.y_eval - y
    size = _norm2(state.f_info.jac.mv(step))
    radius = jnp.where(limited, state.search_state.radius, jnp.inf)
    nearer = y + step * jnp.minimum(1.0, radius / jnp.where(size > 0, size, 1.0))
    # Where there is no radius the point is the solver's own, to the last digit.
    return eqx.tree_at(lambda s: s.y_eval, state, jnp.where(size > radius, nearer, state.y_eval))


def gain_ahead(f_info: Any, residual_norm: Float[Array, ""]) -> Float[Array, ""]:
    """What a full Gauss-Newton step would take off the sum of squares, as the parabola has it.

    That gain, g' F^-1 g, is the squared distance from the optimum in joint standard deviations.
    Unlike the length of a step it asks for no unit, and a direction that the data leave all but
    open is not polished. An unknown that runs off, as the size of a disturbance that is none, has
    such a gain for ever: then the length of the others' steps has to tell.

    Args:
        f_info: residuals and Jacobian at the last point that was accepted.
        residual_norm: by which the residuals are divided, those of a variance of 1.
    """
    J = f_info.jac.as_matrix()
    # A column of zeros, that of an unknown that stays put, has no direction: behind the others in
    # the triangle it takes nothing from them.
    moves = jnp.any(J != 0, axis=0)
    order = jnp.argsort(~moves)
    R = jnp.linalg.qr(jnp.concatenate([J[:, order], f_info.residual[:, None]], axis=1), mode="r")
    gain = jnp.sum(jnp.where(moves[order], jnp.square(R[:-1, -1]), 0.0))
    return gain * residual_norm**2


def _norm2(v: Float[Array, " k"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(jnp.square(v)))


def _norm(convergence_mask: Bool[Array, " q"]) -> Callable[[Array], Array]:
    def norm(x: Array) -> Array:
        # optimistix asks once with the q unknowns and once with the 2 q + 1 rows; their shape
        # tells which. Of the rows the first is the size of the residuals, see `_compressed`.
        unknowns = x.shape == convergence_mask.shape
        return optx.max_norm(jnp.where(convergence_mask, x, 0.0) if unknowns else x[0])

    return norm
