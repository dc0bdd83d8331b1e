"""One problem by several methods, their estimates side by side."""

import math
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

from heli_jax.identification.diagnostics.search import STOPPED
from heli_jax.identification.fit import fit
from heli_jax.identification.methods import METHODS
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit

APART = 2.0
"""joint standard deviations from which on two estimates differ"""


class MethodResult(NamedTuple):
    """What one method makes of the problem."""

    method: str
    fit: Fit | None
    """None where the method refuses the problem"""
    reason: str
    """why there are no numbers; empty where there are"""
    seconds: float

    @property
    def label(self) -> str:
        """The method as reports call it."""
        return METHODS[self.method].label

    @property
    def word(self) -> str:
        """Its verdicts in short."""
        if self.fit is None:
            return "refused"
        if self.fit.status == "not-converged":
            return "not converged"
        words = [] if self.fit.status == "converged" else ["not identifiable"]
        words += [] if self.fit.adequate else ["not adequate"]
        words += ["intervals too narrow"] if self.fit.overconfident else []
        doubted = self.fit.untrusted
        words += [f"{', '.join(doubted)} not trusted"] if doubted else []
        return ", ".join(words) or "converged, adequate"


class MethodComparison(NamedTuple):
    """Methods side by side; the first is the fit's own."""

    results: tuple[MethodResult, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of what is compared: the free parameters, and the delay and the gains of inputs that
        were free beside them."""
        main = self.results[0].fit
        if main is None:
            return ()
        beside = (n for n in main.nuisance if n == "time_shift" or n.startswith("gain "))
        return (*main.estimates, *beside)

    def estimate(self, result: MethodResult, name: str) -> Estimate | None:
        """A method's estimate; None where it has none.

        Args:
            name: of a parameter, delay or gain.
        """
        if result.fit is None or result.reason:
            return None
        return {**result.fit.nuisance, **result.fit.estimates}.get(name)

    def difference(self, other: MethodResult, name: str) -> float | None:
        """An estimate less the main method's, in their joint standard deviations.

        The two are taken as independent. Both come from the same records, so that they differ by
        less than this where both are right: a difference that it shows is one.
        """
        a, b = self.estimate(self.results[0], name), self.estimate(other, name)
        if a is None or b is None:
            return None
        if a.sd is None or b.sd is None or a.sd == b.sd == 0.0:
            return None
        return (b.value - a.value) / math.hypot(a.sd, b.sd)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What of the comparison has to be known."""
        main, *others = self.results
        said = [f"{r.label} has no numbers: {r.reason}" for r in self.results if r.reason]
        if main.fit is None:
            return tuple(said)
        for other in others:
            differences = {n: self.difference(other, n) for n in self.names}
            known = {n: d for n, d in differences.items() if d is not None}
            apart = [f"{n} by {abs(d):.1f}" for n, d in known.items() if abs(d) > APART]
            if apart:
                said.append(
                    f"{other.label} and {main.label} differ in {', '.join(apart)} joint standard "
                    "deviations: what one of them takes for granted does not hold of this record."
                )
            elif known:
                said.append(
                    f"{other.label} and {main.label} agree within {APART:g} joint standard "
                    f"deviations in {', '.join(known)}."
                )
        return tuple(said)


def compare_methods(
    main: Fit,
    others: Mapping[str, Problem | str],
    *,
    starts: int | None = None,
    seed: int = 0,
    max_steps: int = 200,
    progress: Callable[[str], None] | None = None,
) -> MethodComparison:
    """Fit a problem by further methods.

    Args:
        others: by method the problem, or why the method refuses it.
        starts: as `fit` takes it.
        progress: called with a line of text before each longer part of the work.
    """
    report = progress or (lambda _: None)
    results = [MethodResult(main.method, main, _why_none(main), main.timing.get("fit", 0.0))]
    for method, problem in others.items():
        if isinstance(problem, str):
            results.append(MethodResult(method, None, problem, 0.0))
            continue
        report(f"the same by {METHODS[method].label}")
        began = time.perf_counter()
        try:
            estimate = fit(problem, starts=starts, seed=seed, max_steps=max_steps)
            result = MethodResult(method, estimate, _why_none(estimate), 0.0)
        except ValueError as e:  # one that fails must not cost the others
            result = MethodResult(method, None, str(e), 0.0)
        results.append(result._replace(seconds=time.perf_counter() - began))
    return MethodComparison(tuple(results))


def _why_none(fit: Fit) -> str:
    if fit.status != "not-converged":
        return ""
    stopped = [f.sentence for f in fit.findings if f.code == STOPPED]
    return stopped[0] if stopped else "it did not converge"
