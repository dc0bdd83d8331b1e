"""What the three statements of the verdict mean, with the limits that they are decided by."""

from heli_jax.identification.identifiability.verdict import FACTOR
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.adequacy import EXPECTED, EXPLAINED, NEARLY_WHITE
from heli_jax.identification.validation.advice import FAR_FROM_WHITE
from heli_jax.numbers import percent


def meanings(fit: Fit) -> list[tuple[str, str]]:
    """Heading and text of each statement, and of what residuals that are not white do to it.

    Args:
        fit: whose method decides which of the limits hold.
    """
    return [
        (
            "Converged",
            "the last step changed every parameter by less than a thousandth of the sd that it "
            "would have were all else known.",
        ),
        (
            "Determined",
            "by data and priors the 95 % intervals, as they are reported, reach at most a factor "
            f"of {FACTOR:g} to either side, also without the weak priors of biases, offsets and "
            "initial states.",
        ),
        ("Adequate", _adequate(fit)),
        (
            "Not trusted",
            "a misfit that was found moves the estimate by more than half of its 95 % interval, or "
            "by an amount that is not known: the interval is withdrawn.",
        ),
        ("Residuals that are not white", _coloured(fit)),
    ]


def _adequate(fit: Fit) -> str:
    if any(output.against_disturbance is not None for output in fit.adequacy.judged):
        ahead = fit.adequacy.ahead
        what = "simulation" if ahead is None else f"predictions up to {ahead:g} s ahead"
        return (
            f"the error of the {what} has at most {EXPECTED:g} times the power that the estimated "
            "disturbance makes, with innovations that are white or have an autocorrelation below "
            f"{FAR_FROM_WHITE:g} at one sample; or the simulation explains {percent(EXPLAINED, 0)} "
            "of what is not white noise. Nothing in the record speaks against every model."
        )
    return (
        f"the simulation explains at least {percent(EXPLAINED, 0)} of what is not white noise, or "
        f"at most {percent(NEARLY_WHITE, 0)} of the residual's variance is other than that. "
        "Nothing in the record speaks against every model."
    )


def _coloured(fit: Fit) -> str:
    if fit.status == "not-converged":
        intervals = "Of a fit that stopped before an optimum no intervals are given."
    elif fit.overconfident:
        intervals = "The intervals given are not corrected for them and are too narrow."
    elif fit.coloured:
        intervals = "The intervals given are corrected for their autocorrelation."
    else:
        intervals = "There are none here, and the intervals need no correction."
    return (
        f"{intervals} A disturbance in them that knows nothing of the inputs leaves the estimates "
        "unbiased; dynamics that the model lacks bias them, and so does a disturbance under "
        "feedback, and no interval allows for that."
    )
