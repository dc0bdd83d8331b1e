"""Whether the model is adequate: does it explain what was measured, beside noise and disturbance?

That an optimiser arrived and that the data determine the parameters says nothing of it: the best
parameters of a wrong model are found and determined as well as those of the right one.

What is judged is the simulated response of every fitted output. The acceptance card asks for a
variance accounted for (VAF) of 0.9 (Tischler and Remple, 2012, and Jategaonkar, 2006, gate fits of
flights in that region). A model is called inadequate only where it misses that by far: where it
leaves more than a fifth of what is not white noise unexplained, twice what the gate allows.
Between the two there is doubt, and the same advice. White
residuals are adequate whatever the VAF: then all that is left is measurement noise.
Enough explained with residuals that are not white is adequate in size only, and is said so.
With filter error the simulation does not know the disturbance, so it is judged against what the
estimated disturbance lets expect.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.advice import (
    FAR_FROM_WHITE,
    OutputAdequacy,
    Record,
    advice_for,
    is_unstable,
)
from heli_jax.identification.validation.metrics import Metrics, Whiteness
from heli_jax.identification.validation.moves_against import moves_against
from heli_jax.identification.validation.predicts_nothing import predicts_nothing
from heli_jax.numbers import explained_text, percent, vaf_text
from heli_jax.numerics.white_noise import white_part

# params is Any: a record of a model's Params, whose class may be a user's own.

EXPLAINED = 0.8
"""share of what is not white noise that has to be explained"""
NEARLY_WHITE = 0.1
"""share of the residual's variance that may be other than white noise where nothing else is left"""
WORSE = -0.1
"""VAF below which not even a white residual is taken for noise alone: in a short record of noise
chance makes it a few hundredths negative"""
CHANCE = "what is said to be determined is so at an optimum of chance"
EXPECTED = 9.0
"""power of the simulation's error over that which the disturbance lets expect: its square root is
three standard deviations where the disturbance is so slow that the record holds one swing of it"""


class Adequacy(NamedTuple):
    """Whether a model is adequate, why not, and what to do."""

    adequate: bool
    less_than_mean: bool
    """whether some output is followed worse than by its mean"""
    # Its name is a key of fit.json.
    judged: tuple[OutputAdequacy, ...]
    reasons: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    """what looks bad and is as expected"""
    unexplained: tuple[str, ...] = ()
    """the outputs of which the model explains no more than chance does of noise, though their
    residuals are white and others carry the fit"""
    doubts: tuple[str, ...] = ()
    """what forbids to call it adequate, however well it fits"""
    by_chance: bool = False
    """whether nothing measured stands out of the noise, so that any optimum is one of chance"""
    limited: str = ""
    """what keeps an adequate model from a plain yes beside residuals that are not white"""
    at_optimum: bool = True
    """whether the optimiser arrived"""
    ahead: float | None = None
    """[s] that is predicted at most where that, and no simulation, was judged"""

    def doubted(self, doubts: Sequence[str]) -> "Adequacy":
        """The same with such doubts, each in a few words: not adequate where there is one."""
        doubts = (*self.doubts, *doubts)
        return self._replace(adequate=False, doubts=doubts) if doubts else self

    def only_if(self, words: Sequence[str]) -> "Adequacy":
        """The same, no plain yes where there are such reasons, each in a few words."""
        return self._replace(limited="; ".join([*filter(None, [self.limited]), *words]))

    @property
    def unjudged(self) -> bool:
        """Whether the optimiser stopped before an optimum: how a model looks there says nothing."""
        return not self.at_optimum

    @property
    def doubtful(self) -> bool:
        """Whether some output misses the card's gate, though not by far."""
        return any(output.doubtful for output in self.judged)

    @property
    def coloured(self) -> tuple[str, ...]:
        """The outputs whose residuals (innovations) are not white."""
        return tuple(output.output for output in self.judged if not output.white)

    @property
    def summary(self) -> str:
        """`yes`, `in size only (the residuals of p are not white)`, `not judged`, or
        `no (VAF of p is -41.0 %, less than its mean)`."""
        if self.unjudged:
            return "not judged"
        if self.adequate:
            limited = [self.limited] if self.limited else []
            left = "; ".join([*limited, *(self._left_over if self.coloured else [])])
            words = f"in size only ({left})" if left else "yes"
            if self.one_step_only:
                left = "; ".join([*limited, *self._left_over, *self._simulated_worse])
                words = f"one step ahead only ({left})"
            if self.unexplained:
                words += f", but nothing of {' and '.join(self.unexplained)} is explained"
            return words
        bad = [output for output in self.judged if not output.adequate]
        words = list(self.doubts) + [
            f"VAF of {output.output} is {vaf_text(output.vaf)}"
            + (", less than its mean" if output.vaf < 0 else "")
            for output in bad
        ]
        return f"no ({'; '.join(words)})" if words else "no"

    @property
    def one_step_only(self) -> tuple[str, ...]:
        """The outputs that an adequate model predicts one step ahead (filter error), though driven
        by the inputs alone it follows them worse than their mean does."""
        # Of what is predicted further ahead the VAF is no simulation's, and a remark gives it.
        if self.ahead is not None:
            return ()
        return tuple(o.output for o in self.judged if o.disturbed_below_mean)

    @property
    def _simulated_worse(self) -> list[str]:
        return [
            f"VAF of {o.output}, simulated, is {vaf_text(o.vaf)}, less than its mean"
            for o in self.judged
            if o.disturbed_below_mean
        ]

    @property
    def _left_over(self) -> list[str]:
        """What keeps an adequate model from a plain yes."""
        filtered = any(output.against_disturbance is not None for output in self.judged)
        what = "innovations" if filtered else "residuals"
        coloured = [f"the {what} of {', '.join(self.coloured)} are not white"]
        words = coloured if self.coloured else []
        # Between what is adequate and what the acceptance card asks for.
        return words + [
            f"VAF of {output.output} is {vaf_text(output.vaf)}"
            for output in self.judged
            if output.doubtful
        ]

    @property
    def sentences(self) -> tuple[str, ...]:
        """For the notes of a fit."""
        return (*self.reasons, *self.advice, *self.remarks)


UNJUDGED = Adequacy(True, False, ())
"""what a Fit has that nobody judged"""


class Evidence(NamedTuple):
    """What adequacy is assessed by: the fitted flights, and what is known of their residuals."""

    records: tuple[Record, ...]
    agreement: Mapping[str, Metrics]
    """of the simulation, by output over all fitted flights"""
    whiteness: Mapping[str, Whiteness]
    """by 'flight/output', of the residuals, with filter error of the innovations"""
    error_ratio: Mapping[str, float] | None = None
    """with a disturbance, by output the power of the simulation's error over that which disturbance
    and noise make; without, the simulation has to explain by itself"""
    unknowns: int = 0
    """how many were estimated; a response that explains no more than as many unknowns explain of
    noise by chance shows nothing"""
    innovations: tuple[Mapping[str, np.ndarray] | None, ...] = ()
    """by flight and output (N,), SI: the errors of the prediction one step ahead"""
    ahead: float | None = None
    """[s] that is predicted at most, from a filter's states, where that stands in place of the
    simulation: of an unstable model"""


def assess(problem: Problem, params: Any, evidence: Evidence) -> Adequacy:
    """Whether the model is adequate to the fitted flights.

    Args:
        problem: what was fitted.
        params: the vehicle with the estimates in place, a record of the model's Params, SI.
        evidence: measured and simulated outputs, and what is left between them.
    """
    disturbed = evidence.error_ratio is not None
    # Linearising takes a compiled program of its own, so it is asked only where the answer counts.
    unstable = disturbed and evidence.ahead is None and is_unstable(problem, params)
    outputs = tuple(
        _of_output(name, m, evidence, unstable)
        for name, m in evidence.agreement.items()
        if not _still(name, evidence.records)
    )
    bad = [output for output in outputs if not output.adequate]
    if outputs and not bad and not disturbed and not _stands_out(outputs, evidence):
        return _nothing_shown(outputs)
    unexplained = [o for o in outputs if o.adequate and _nothing_explained(o, evidence)]
    doubted = [*bad, *(output for output in outputs if output.doubtful)]
    unstable = unstable or (bool(bad) and is_unstable(problem, params))
    apart = len(doubted) < len(outputs)
    advice = [
        text
        for output in doubted
        for text in advice_for(problem, output, evidence.records, unstable, apart)
    ]
    return Adequacy(
        not bad,
        # Written so that a VAF that is no number counts as less than the mean.
        any(not output.vaf >= 0 for output in bad),
        outputs,
        tuple(_reason(output, evidence.ahead) for output in bad),
        tuple(dict.fromkeys(advice)),
        (
            *_as_expected(outputs, evidence.ahead),
            *(_unexplained(output) for output in unexplained),
            *(_stays(n) for n in evidence.agreement if _still(n, evidence.records)),
        ),
        tuple(output.output for output in unexplained),
        ahead=evidence.ahead,
    )


def by_responses(
    agreement: ResponseAgreement | None, simulated: Mapping[str, Metrics] | None = None
) -> Adequacy | None:
    """Whether a model is adequate to measured frequency responses: by the squared errors over their
    variance, which gusts do not change, while a simulation in time knows nothing of gusts.

    Args:
        agreement: of the model's responses with the measured ones; None where none were fitted.
        simulated: by output the model driven by the inputs alone.
    """
    if agreement is None:
        return None
    misfit = (agreement.misfit,) if agreement.misfit else ()
    if agreement.doubt:
        remarks, doubts = agreement.sentences, (agreement.doubt,)
        less = any(m.vaf < 0 for m in (simulated or {}).values())
        return Adequacy(False, less, (), misfit, remarks=remarks, doubts=doubts)
    return Adequacy(
        True, False, (), remarks=(*misfit, *agreement.sentences), limited=agreement.limit
    )


def _as_expected(outputs: tuple[OutputAdequacy, ...], ahead: float | None) -> list[str]:
    """What looks bad and is what the estimated disturbance makes."""
    if ahead is not None:
        vafs = ", ".join(f"{output.output} {vaf_text(output.vaf)}" for output in outputs)
        return [
            "No simulation of the model can follow the record, since it is unstable over its "
            "length or the disturbance moves it beyond where it is nearly linear: it is judged by "
            f"predictions up to {ahead:g} s ahead from the filter's state (VAF: {vafs})."
        ]
    return [
        f"Driven by the inputs alone, the model follows {output.output} worse than its mean does "
        f"(VAF {vaf_text(output.vaf)}), as the estimated disturbance lets expect. If none acted, "
        "are the columns, signs and units the right ones?"
        for output in outputs
        if output.disturbed_below_mean
    ]


_BY_CHANCE = 1e-3
"""probability that noise alone is explained as well"""


def _stands_out(outputs: tuple[OutputAdequacy, ...], evidence: Evidence) -> bool:
    """Whether the response of some output stands out of the noise."""
    # One output that stands out is enough: the others may be ones that these inputs do not move.
    return not outputs or not all(_of_noise(output, evidence) for output in outputs)


def _nothing_explained(output: OutputAdequacy, evidence: Evidence) -> bool:
    """Whether of an output nothing is explained, simulated or one step ahead."""
    if evidence.error_ratio is None:
        return _of_noise(output, evidence)
    if not output.explained < 1.0 - EXPLAINED:
        return False
    return predicts_nothing(
        [
            (r.measured[output.output], ahead[output.output])
            for r, ahead in zip(evidence.records, evidence.innovations, strict=False)
            if ahead is not None and output.output in r.measured
        ]
    )


def _of_noise(output: OutputAdequacy, evidence: Evidence) -> bool:
    """Whether of an output no more is explained than of noise alone: a likelihood ratio of the
    model against a constant (Wilks, 1938)."""
    unknowns = evidence.unknowns
    if unknowns < 1 or not np.isfinite(output.vaf):
        return False
    n = int(np.isfinite(_of_all_flights(output.output, evidence.records)).sum())
    # Twice the gain in log-likelihood of white noise with unknown variance: n log(1/(1 - VAF)),
    # which noise alone makes chi-squared with one degree of freedom an unknown.
    gain = -n * np.log(max(1.0 - output.vaf, 1e-300))
    return bool(scipy.special.chdtrc(unknowns, max(gain, 0.0)) >= _BY_CHANCE)


def _unexplained(output: OutputAdequacy) -> str:
    if output.against_disturbance is not None:
        return (
            f"The model explains nothing of {output.output}: simulated VAF "
            f"{vaf_text(output.vaf)}, and one step ahead the filter predicts it hardly "
            "better than its mean or the sample before. Either nothing moves it, or what "
            "the log has there is noise or vibration."
        )
    return (
        f"The model explains nothing of {output.output} (VAF {vaf_text(output.vaf)}), no "
        "more than as many unknowns explain of noise alone; the other outputs carry the fit. Its "
        "residuals are white: either the inputs do not move it, or what the log has there is no "
        "measurement."
    )


def _stays(name: str) -> str:
    return (
        f"The measured {name} never moves: its VAF is undefined, and nothing of it is judged. Is "
        "it the right column, and does the sensor work?"
    )


def _of_all_flights(name: str, records: tuple[Record, ...]) -> np.ndarray:
    """The measured output (any,), flight after flight."""
    return np.concatenate([r.measured[name] for r in records if name in r.measured])


def _nothing_shown(outputs: tuple[OutputAdequacy, ...]) -> Adequacy:
    words = " and ".join(f"{output.output} (VAF {vaf_text(output.vaf)})" for output in outputs)
    return Adequacy(
        False,
        False,
        tuple(output._replace(adequate=False) for output in outputs),
        (
            f"The response does not stand out of the noise in {words}: as many unknowns explain "
            "as much of noise alone.",
        ),
        ("Use larger or more inputs, a longer record, or an output with less noise.",),
        doubts=(CHANCE,),
        by_chance=True,
    )


def _still(name: str, records: tuple[Record, ...]) -> bool:
    """Whether an output never moves: nothing is to be explained."""
    # By its range: the mean of equal numbers, and so their variance, is off by rounding. As
    # `metrics` has it, so that what has no VAF is not judged by one.
    return all(
        np.nanmax(y) - np.nanmin(y) <= 1e-9 * np.nanmax(np.abs(y))
        for y in (r.measured[name] for r in records if name in r.measured)
    )


def _of_output(name: str, m: Metrics, evidence: Evidence, unstable: bool) -> OutputAdequacy:
    records = [r for r in evidence.records if name in r.measured]
    tests = [evidence.whiteness[f"{r.label}/{name}"] for r in records]
    white = all(test.white for test in tests)
    lag1 = max((test.lag1 for test in tests), key=abs)
    ratio = None if evidence.error_ratio is None else evidence.error_ratio[name]
    error = [r.measured[name] - r.simulated[name] for r in records]
    explained, other = _explained(error, _of_all_flights(name, evidence.records))
    if not np.isfinite(m.vaf):
        return OutputAdequacy(name, False, m.vaf, float("nan"), white, lag1, ratio)
    # By the share of what is not white noise: a good model of a noisy sensor has a low VAF, and no
    # better model could raise it.
    enough = explained >= EXPLAINED
    if ratio is None:
        noise_alone = (white or other <= NEARLY_WHITE) and m.vaf >= WORSE
        return OutputAdequacy(name, bool(enough or noise_alone), m.vaf, explained, white, lag1)
    # Of an unstable model the filter expects any error of a simulation: then its innovations are
    # all there is to judge by.
    expected = ratio <= EXPECTED and (white or (abs(lag1) < FAR_FROM_WHITE and not unstable))
    expected = expected and not moves_against(name, evidence.records)
    adequate = bool(enough or expected)
    return OutputAdequacy(name, adequate, m.vaf, explained, white, lag1, ratio)


def _explained(error: list[np.ndarray], measured: np.ndarray) -> tuple[float, float]:
    """Share explained of what is not white noise, and the part of the error that is not; `error`
    by flight."""
    with np.errstate(all="ignore"):  # a simulation that diverges overflows in its square
        residual, total = float(np.nanvar(np.concatenate(error))), float(np.nanvar(measured))
        # Flight by flight, since differences across the joint of two flights are no noise.
        sizes = [int(np.count_nonzero(~np.isnan(r))) for r in error]
        noises = [white_part(r) ** 2 for r in error]
        noise = float(np.average(noises, weights=sizes))
    if not np.isfinite(residual):
        return float("nan"), float("nan")
    # The guess of the noise may exceed a residual that is noise alone.
    other = max(residual - noise, 0.0)
    rest = max(total - min(noise, residual), 1e-300)
    return 1.0 - other / rest, other / residual if residual > 0 else 0.0


def _reason(output: OutputAdequacy, ahead: float | None) -> str:
    name, vaf, ratio = output.output, output.vaf, output.against_disturbance
    if ahead is not None:
        return (
            f"{name} predicted up to {ahead:g} s ahead misses the measured one by "
            f"{np.sqrt(ratio or np.nan):.2g} times what the estimated disturbance explains (VAF "
            f"{vaf_text(vaf)}, autocorrelation of the innovations {output.lag1:+.2f} at one "
            "sample)."
        )
    if not np.isfinite(vaf):
        return f"The simulated {name} is not finite: nothing of it is explained."
    if vaf < 0:
        return (
            f"Driven by the inputs alone, the model follows {name} worse than its mean does (VAF "
            f"{vaf_text(vaf)}): its parameters mean little. Are the columns, signs and units the "
            "right ones, and the start values near?"
        )
    if ratio is not None and ratio > EXPECTED:
        return (
            f"The simulated {name} misses the measured one by {ratio**0.5:.2g} times what the "
            f"estimated disturbance explains (VAF {vaf_text(vaf)})."
        )
    if ratio is not None:
        return (
            f"The innovations of {name} are far from white (autocorrelation {output.lag1:+.2f} "
            f"at one sample) and its simulation explains little (VAF {vaf_text(vaf)})."
        )
    return (
        f"The model explains {explained_text(output.explained)} of what in {name} is not white "
        f"noise, expected at least {percent(EXPLAINED, 0)} (VAF {vaf_text(vaf)}); the acceptance "
        "card asks for a VAF of 90 %."
    )
