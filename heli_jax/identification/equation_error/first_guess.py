"""First guesses of parameters by equation error: plain data, and what is said of them."""

from typing import Literal, NamedTuple

from heli_jax.identification.equation_error.regression import Selection

# The limit of a stepwise regression; in a file of its own, since a configuration states it too.


F_ENTER = 20.0
"""five times the 5 % point of F (Klein and Morelli): terms below it hardly help to predict"""


Origin = Literal["equation error", "frequency error", "as stated", "vehicle", "not selected"]


class StartValue(NamedTuple):
    """Where a fit begins with one parameter. The names of the fields are keys of fit.json."""

    value: float
    sd: float | None
    """standard error of the regression, without its bias, or that of frequency error; None where
    the value is from neither, and where several solutions fit as well"""
    unit: str
    origin: Origin
    reason: str
    """why it is not from the regression or from frequency error; empty where it is"""


class Equation(NamedTuple):
    """One equation as it was regressed."""

    name: str
    """the state whose derivative it gives, or the output"""
    r_squared: float


class EquationErrorStart(NamedTuple):
    """First guesses, and how they were found."""

    values: dict[str, StartValue]
    equations: tuple[Equation, ...]
    half_width: float
    """of the smoothing kernel [s]"""
    hidden: tuple[str, ...]
    """states that nothing measured shows: integrated by their own equations"""
    selection: Selection | None = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was taken from where."""
        return tuple(_sentences(self))


def _sentences(start: EquationErrorStart) -> list[str]:
    taken = [n for n, v in start.values.items() if v.origin == "equation error"]
    fits = ", ".join(f"{e.name} {100 * e.r_squared:.0f} %" for e in start.equations)
    sentences = [
        f"Start by equation error of {', '.join(taken) or 'nothing'} (variance explained in the "
        f"equations of {fits}; smoothed over {start.half_width:.2g} s to either side). "
        "Noise and gusts bias these values: the fit begins there, they are not its result."
    ]
    if start.hidden:
        sentences.append(
            f"Start: {', '.join(start.hidden)} are not measured and were integrated by their own "
            "equations."
        )
    # One sentence for all that have the same reason: of a whole helicopter there are many.
    grouped: dict[tuple[str, str], list[str]] = {}
    for name, v in start.values.items():
        if v.reason:
            grouped.setdefault((v.origin, v.reason), []).append(f"{name} {v.value:.4g}")
    for (origin, reason), values in grouped.items():
        sentences.append(f"Start: {', '.join(values)}, {_WHERE[origin]}: {reason}.")
    return sentences


_WHERE = {
    "equation error": "moved inside",
    "as stated": "as stated",
    "vehicle": "the vehicle's",
    "not selected": "where it leaves the model as it is",
}
