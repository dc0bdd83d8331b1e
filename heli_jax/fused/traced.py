"""The run of one element, split into parts computed once and parts computed at every sample."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from heli_jax.fused.kernel import Argument, Kernel, Run
from heli_jax.numerics.hoist import hoisted

# `Any` below: trees of arrays, and jaxprs.


type Making = Callable[[Any, Any, Any], Any]
"""Function of (shared values, records (N, ...), an element's own values) that returns a run as in
`heli_jax.simulation.accumulate.Steps`.
"""


class Traced(NamedTuple):
    """A run prepared for translation, with the computations before it."""

    run: Run
    results: Any
    """Tree structure of the results."""
    begin: Any
    """Jaxpr of (shared, records, element): the first carry, then the constants."""

    @property
    def varies(self) -> tuple[bool, ...]:
        """Return a flag for each constant: True if every element has its own."""
        return tuple(not argument.shared for argument in self.run.stays)

    def _before(self, *arguments: Any) -> tuple[list[Any], list[Any]]:
        outputs = core.jaxpr_as_fun(self.begin)(*jax.tree.leaves(arguments))
        n = len(self.run.carry)
        return outputs[:n], outputs[n:]

    def own(self, shared: Any, records: Any, element: Any) -> tuple[list[Any], list[Any]]:
        """Return an element's first carry and its own constants. JAX can trace it."""
        carry, stay = self._before(shared, records, element)
        return carry, [v for v, varying in zip(stay, self.varies, strict=True) if varying]

    def common(self, shared: Any, records: Any, element: Any) -> list[Any]:
        """Return the constants that all elements share, computed from any of them."""
        _, stay = self._before(shared, records, element)
        return [v for v, varying in zip(stay, self.varies, strict=True) if not varying]

    def compute(
        self,
        kernel: Kernel,
        begun: tuple[list[Any], list[Any]],
        common: Any,
        records: Any,
        threads: int,
    ) -> Any:
        """Compute the runs of elements.

        Args:
            kernel: kernel of `run`.
            begun: result of `own` for each element.
            common: result of `common`.
            records: records as traced.

        Returns:
            The results of each element.
        """
        carry, own = jax.tree.map(np.asarray, begun)
        of_own, of_common = iter(own), iter(map(np.asarray, common))
        stays = [next(of_own if varying else of_common) for varying in self.varies]
        stored = [np.asarray(v) for v in jax.tree.leaves(records)]
        return jax.tree.unflatten(self.results, kernel(stays, stored, carry, threads))


def traced(
    making: Making,
    shared: Any,
    records: Any,
    element: Any,
) -> Traced:
    """Trace a run.

    Args:
        records: arrays (N,) that are read by sample, the same for all elements.
        element: an example of an element's own values.

    Raises:
        UnsupportedError: a part of it has no translation.
    """
    sample = np.zeros((), np.int32)

    def step(own: Any, records: Any, carry: Any, k: Any) -> Any:
        return making(own[0], records, own[1]).step(carry, k)

    def last(own: Any, records: Any, carry: Any) -> Any:
        return making(own[0], records, own[1]).last(carry)

    parts: dict[str, Any] = {}

    def begin(shared: Any, inputs: Any, element: Any) -> Any:
        """Return the carry before the first sample, and the constants."""
        run = making(shared, inputs, element)
        carry, parts["steps"] = run.carry, run.steps
        own = shared, element
        of_step, a_step = hoisted(step, own, inputs, carry, sample)
        of_last, the_last = hoisted(last, own, inputs, carry)
        both, n = [*of_step, *of_last], len(of_step)
        # Traced here, where the constants' values are available.
        parts["step"] = jax.make_jaxpr(lambda v, *rest: a_step(v[:n], *rest))(
            both, records, carry, sample
        )
        parts["last"], shape = jax.make_jaxpr(
            lambda v, *rest: the_last(v[n:], *rest), return_shape=True
        )(both, records, carry)
        parts["results"] = jax.tree.structure(shape)
        return carry, both

    closed, shape = jax.make_jaxpr(begin, return_shape=True)(shared, records, element)
    carried, stay = (jax.tree.leaves(part) for part in shape)
    rows = [np.asarray(v) for v in jax.tree.leaves(records)]
    n_common = len(jax.tree.leaves(shared)) + len(rows)
    varies = _vary(closed.jaxpr, closed.jaxpr.invars[n_common:])[len(carried) :]
    run = Run(
        parts["step"],
        parts["last"],
        tuple(
            Argument(v.shape, np.dtype(v.dtype), not varying)
            for v, varying in zip(stay, varies, strict=True)
        ),
        tuple(Argument(v.shape, v.dtype, True) for v in rows),
        tuple(Argument(v.shape, np.dtype(v.dtype), False) for v in carried),
        parts["steps"],
    )
    return Traced(run, parts["results"], closed)


def _vary(jaxpr: Any, arguments: Sequence[Any]) -> list[bool]:
    """Return a flag for each result: True if it depends on these arguments."""
    own = set(arguments)
    for equation in jaxpr.eqns:
        # A literal has no hash, and depends on nothing.
        if any(not hasattr(v, "val") and v in own for v in equation.invars):
            own |= set(equation.outvars)
    return [not hasattr(v, "val") and v in own for v in jaxpr.outvars]
