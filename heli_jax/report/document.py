"""fit.json: one table of its keys, used to write, check and document it.

A section is a class whose fields are keys. The value of a key is the attribute of its name, unless
`Annotated` states another attribute or a function. `model_of` makes the pydantic model of a
section. A number that is not finite is null in the file.
"""

import functools
import json
import math
import operator
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, TypedDict

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
    create_model,
    model_validator,
)

from heli_jax import naming
from heli_jax.analysis.attitude_responses import Handling, HandlingPair
from heli_jax.analysis.handling_qualities import NUMBERS, UNITS, HandlingQualities, Number
from heli_jax.analysis.response_agreement import USUAL_J, ResponseAgreement
from heli_jax.finding import Distrust, Finding, sentences
from heli_jax.flights import Flight
from heli_jax.flights.flight import as_content
from heli_jax.identification.diagnostics.residuals import COLOURED, TOO_NARROW
from heli_jax.identification.equation_error.start import (
    Equation,
    StartValue,
)
from heli_jax.identification.estimation.multistart import StartRow
from heli_jax.identification.fit import Fit
from heli_jax.identification.identifiability.profile import Profile
from heli_jax.identification.identifiability.verdict import Combination, Pair
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Status
from heli_jax.identification.select import Candidate, MethodComparison, Nested
from heli_jax.identification.uncertainty.nuts import Convergence
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    EXPLAINED,
    NEARLY_WHITE,
    OutputAdequacy,
)
from heli_jax.identification.validation.follows_response import LEVEL, Feedback
from heli_jax.identification.validation.held_out import HeldOutFrequency
from heli_jax.identification.validation.metrics import Metrics, Whiteness
from heli_jax.report.card import Gate, card
from heli_jax.schema_keys import Key, keys_of
from heli_jax.versions import versions

ABSENT = object()
"""Value of a source for a key that the file lacks."""


class VerdictContent(TypedDict):
    """Identifiability: verdict, rank, singular values and correlations."""

    text: str
    """Verdict in one sentence."""
    identifiable: bool
    """True if every free parameter is identifiable."""
    rank: int
    """Number of determined directions, priors included."""
    rank_without_priors: int
    condition_number: Annotated[float, "condition"]
    singular_values: list[float]
    """Singular values of the whitened sensitivities in relative coordinates; each is 1 / sd of a
    direction."""
    null_directions: list[dict[str, float]]
    """Directions that the data do not determine, by parameter in relative coordinates."""
    determined_combinations: Annotated[list[Combination], "combinations"]
    """Combinations that the data determine, unless every parameter is identifiable."""
    strong_pairs: Annotated[list[Pair], "pairs"]
    """Strongly correlated parameters."""
    without_effect: list[str]
    """Parameters without effect on any output."""
    resting_on_priors: Annotated[list[str], "resting"]
    """Parameters determined by priors instead of data."""
    exchangeable_nuisances: Annotated[list[str], "exchangeable"]
    """Nuisances, such as `flight 1/bias p`, that are exchangeable with parameters."""
    other_solutions: Annotated[list[dict[str, float]], lambda v: [s.values for s in v.second]]
    """Other values of the free parameters that fit as well [SI]."""
    names: list[str]
    """Order of `correlation` and `covariance_log`."""
    correlation: list[list[float]]
    covariance_log: Annotated[list[list[float]], "covariance"]
    """Covariance in relative coordinates (a logarithm, or the value over a scale), without null
    directions."""


class AdequacyAgainst(TypedDict):
    """Limits of the version that wrote the file."""

    explained_at_least: Annotated[float, lambda _: EXPLAINED]
    or_other_than_white_noise_at_most: Annotated[float, lambda _: NEARLY_WHITE]
    or_power_over_what_the_disturbance_makes_at_most: Annotated[float, lambda _: EXPECTED]


class AdequacyContent(TypedDict):
    """Adequacy of the model for the record."""

    summary: Annotated[str, "adequate_in_words"]
    """The statement on adequacy in a few words."""
    judged: Annotated[list[OutputAdequacy], "adequacy.judged"]
    by_chance: Annotated[bool, "adequacy.by_chance"]
    """True if no output differs from noise, so that the optimum is arbitrary."""
    ahead: Annotated[float | None, "adequacy.ahead"]
    """Longest prediction [s], if predictions were judged instead of a simulation."""
    against: Annotated[AdequacyAgainst, lambda fit: fit]


class Fixed(TypedDict):
    """Keys in addition to the fields of the class."""

    value: float | list[float] | None
    """Estimate, null if not identifiable; one number for each flight if flights state it."""
    fixed: Annotated[bool, lambda _: False]
    """True if flights state it; the other keys are then missing."""


class Residuals(TypedDict):
    """Residuals of the measurements."""

    white: bool
    overconfident: bool
    """True if the intervals ignore the autocorrelation of the residuals."""
    note: Annotated[str, lambda fit: _whiteness_note(fit)]
    """Consequence if they are not white."""
    by_output: Annotated[dict[str, Whiteness], "whiteness"]
    """Whiteness by `flight/output`; of the innovations with filter error."""


class FeedbackToo(TypedDict):
    """Keys in addition to the fields of the class."""

    present: bool
    """True if the input follows the response: the p-value is below the level."""
    level: Annotated[float, lambda _: LEVEL]


class ResponsesToo(TypedDict):
    """Keys in addition to the fields of the class."""

    averages: Annotated[dict[str, float], lambda agreement: dict(agreement.averages)]
    """Independent averages by output."""
    usual_J: Annotated[float, lambda _: USUAL_J]
    """Tischler's limit of a good fit."""


class CandidatesCompared(TypedDict):
    """Compared models."""

    candidates: list[Candidate]
    """Candidates, best AIC first."""
    nested: list[Nested]
    """Likelihood-ratio tests."""
    sentences: list[str]


class MethodContent(TypedDict):
    """Result of the same problem by another method."""

    status: str
    """As `status` of the fit, or refused."""
    verdict: str
    reason: str | None
    """Reason why it was refused, or has no result."""
    seconds: float
    parameters: dict[str, Estimate]
    difference_joint_sd: dict[str, float]
    """Difference from the first method's estimate, in joint standard deviations."""
    findings: list[Finding]


class MethodsCompared(TypedDict):
    """Results of several methods."""

    results: Annotated[dict[str, MethodContent], lambda compared: _methods(compared)]
    sentences: list[str]


class Nuts(TypedDict):
    """Convergence of the NUTS chains."""

    rhat: float
    """Largest R-hat."""
    effective: float
    """Fewest independent draws."""
    divergent: int
    trusted: bool
    by_parameter: Annotated[dict[str, Convergence], "convergence"]


class IntervalsContent(TypedDict, total=False):
    """95 % intervals by several methods."""

    by_parameter: dict[str, dict[str, list[float]]]
    """Both ends by parameter and method (gaussian, profile, bootstrap, nuts)."""
    profiles: dict[str, Profile]
    sentences: list[str]
    bootstrap_failures: Annotated[int, lambda i: i.bootstrap.failures if i.bootstrap else ABSENT]
    """Bootstrap refits that did not converge."""
    nuts: Annotated[Nuts, lambda i: i.posterior or ABSENT]
    """NUTS samples."""


class Compatibility(TypedDict):
    """Result of `heli-jax compatibility`."""

    compatible: bool
    verdict: str
    doubts: list[Finding]
    shows: Annotated[dict[str, str], lambda s: {r[0]: r[s.head.index("shows")] for r in s.errors}]
    """Presence of each sensor error: yes or no."""


class Continuous(TypedDict):
    """Transfer function of the recursive least squares."""

    num: Annotated[list[float], "continuous_num"]
    """Coefficients, highest power of s first."""
    den: Annotated[list[float], "continuous_den"]
    exact: bool
    """True if its zero-order hold equivalent is the discrete one."""
    note: str


class BaselineContent(TypedDict):
    """Recursive least squares, from an input to an output of one flight."""

    flight: str
    input: str
    output: str
    order: int
    forgetting: float
    theta: list[float]
    """Coefficients of the difference equation."""
    poles: Annotated[list[list[float]], lambda b: [[p.real, p.imag] for p in b.poles]]
    """Real and imaginary part of each pole."""
    continuous: Annotated[Continuous, lambda b: b]
    combinations: dict[str, float]
    """Ratios of the paper's equation 23."""
    metrics: Annotated[dict[str, Metrics], lambda b: {b.output: b.metrics}]
    """Agreement of its simulation."""
    trusted: bool
    sentences: list[str]


class QualityToo(TypedDict):
    """Keys in addition to the fields of the class."""

    unit: str


class Qualities(TypedDict, total=False):
    """Handling qualities of a response, of the model or of the data."""

    numbers: dict[str, Number | None]
    """Values by name; null if not determined."""
    sentences: list[str]
    sign: int
    """-1 if the sign of the response was reversed."""
    band_rad_s: list[float]
    """Band in which the response is known."""


class HandlingToo(TypedDict):
    """Keys in addition to the fields of the class."""

    model: Qualities | None
    data: Qualities | None
    """Null if no response was requested."""


class EquationErrorContent(TypedDict):
    """Start values by equation error."""

    values: dict[str, StartValue]
    equations: list[Equation]
    smoothing_half_width_s: Annotated[float, "half_width"]
    not_measured: Annotated[list[str], "hidden"]
    """States that no output determines."""
    sentences: Annotated[list[str], lambda start: sentences(start.findings)]


class SignalSource(TypedDict, total=False):
    """Source of a model's signal."""

    signal: str
    """Channel of the log; missing for a constant."""
    constant: float
    unit: str
    scale: float
    offset: float
    invert: bool
    origin: str
    """Processing between log and signal, in words."""


class SignalSources(TypedDict):
    """Sources by name of the model's signal."""

    inputs: dict[str, SignalSource]
    outputs: dict[str, SignalSource]


class FlightSource(TypedDict, total=False):
    """Source of a flight; one given in memory has no path and no signals."""

    path: str | None
    sha256: str | None
    """Fingerprint of the whole file."""
    flight: str
    hold_out: bool
    """True if it was used only for validation."""
    n_samples: int
    dt: float
    """Sample time [s]."""
    window: list[float]
    """Start and end, from the log's beginning [s]."""
    log_first_time: float
    """First time in the log's own count [s]."""
    notes: list[Finding]
    """Assumptions and corrections of the reader."""
    signals: SignalSources


class HoldContent(TypedDict):
    """Hold of an input between samples."""

    hold: Literal["zero-order", "linear", "mixed"]
    reason: str


_NOISE = ("white", "coloured residuals")


VERSION = 1
"""Version of the format; it changes if a key is removed or changes its meaning."""


class FitFile(TypedDict):
    """fit.json."""

    format: Annotated[int, lambda _: VERSION]
    """Version of this format; missing in files of earlier versions of the program."""
    status: Annotated[Status, "fit.status"]
    """Convergence and identifiability."""
    exit_code: Annotated[Literal[0, 3, 4], "fit.exit_code"]
    """0: the intervals are usable; 3: not identifiable, or not trusted; 4: not converged, or not
    adequate."""
    model: Annotated[str, "fit.model"]
    method: Annotated[str, "fit.method"]
    instruments: Annotated[list[str], "fit.instruments"]
    """Inputs replaced by a logged excitation."""
    n_samples: Annotated[int, "fit.n_samples"]
    """Number of measured values that were fitted."""
    identifiable: Annotated[bool, "fit.verdict.identifiable"]
    """True if data and priors determine every free parameter."""
    adequate: Annotated[bool | None, lambda a: _adequate(a.fit)]
    """True if the model explains the record; null if not judged."""
    adequacy: Annotated[AdequacyContent, "fit"]
    null_directions: Annotated[list[dict[str, float]], "fit.verdict.null_directions"]
    """As in `verdict`."""
    determined_combinations: Annotated[list[Combination], "fit.verdict.combinations"]
    """As in `verdict`."""
    verdict: Annotated[VerdictContent, "fit.verdict"]
    """Identifiability at the estimates."""
    verdict_before: Annotated[VerdictContent, "fit.verdict_before"]
    """Identifiability at the start values."""
    parameters: Annotated[dict[str, Estimate], lambda a: _parameters(a)]
    """Free parameters, and those that flights state [SI]."""
    constants: Annotated[dict[str, float], lambda a: _constants(a.fit, a.problem)]
    """Constants of the vehicle [SI]."""
    nuisance: Annotated[dict[str, Estimate], lambda a: _shown(a.fit.nuisance, a.fit.status)]
    """Gains, delays, disturbances, initial states, biases; those of one flight as `flight/name`."""
    noise_sd: Annotated[dict[str, float], "fit.noise"]
    """sd of the measurement noise by `flight/output` [SI]."""
    metrics: Annotated[dict[str, Metrics], "fit.metrics"]
    """Metrics of the simulation by output, for fitted flights."""
    validation: Annotated[dict[str, Metrics], "fit.validation"]
    """Metrics of the simulation by output, for held-out flights."""
    validation_free_run: Annotated[dict[str, Metrics], "fit.validation_free_run"]
    """Metrics of an uninterrupted simulation for held-out flights, if windows were used."""
    one_step: Annotated[dict[str, Metrics], "fit.one_step"]
    """Metrics of one-step predictions by output, for fitted flights."""
    one_step_validation: Annotated[dict[str, Metrics], "fit.one_step_validation"]
    """Metrics of one-step predictions by output, for held-out flights."""
    acceptance: Annotated[list[Gate], lambda a: card(a.fit, a.supplementary.responses)]
    """Lines of the acceptance card."""
    models: Annotated[CandidatesCompared | None, "supplementary.choice"]
    methods: Annotated[MethodsCompared | None, "supplementary.methods"]
    intervals: Annotated[IntervalsContent | None, "supplementary.intervals"]
    compatibility: Annotated[Compatibility | None, "supplementary.sensors"]
    log_likelihood: Annotated[float, "fit.log_likelihood"]
    unknowns: Annotated[int, "fit.unknowns"]
    """Number of estimated values, those of the noise included."""
    aic: Annotated[float, "fit.aic"]
    bic: Annotated[float, "fit.bic"]
    covariance: Annotated[Literal["white", "coloured residuals"], lambda a: _NOISE[a.fit.coloured]]
    """Assumption of the intervals on the residuals."""
    residuals: Annotated[Residuals, "fit"]
    feedback: Annotated[list[Feedback], "fit.feedback"]
    """Feedback by flight and freely moving input."""
    untrusted: Annotated[dict[str, Distrust], "fit.distrusts"]
    """Reason why a parameter's interval is unusable, by parameter."""
    distrust: Annotated[str, "fit.distrust"]
    """The same in sentences; empty if all intervals are trusted."""
    responses: Annotated[ResponseAgreement | None, "fit.responses"]
    """Result of a fit of frequency responses."""
    held_out_frequency: Annotated[HeldOutFrequency | None, "fit.held_out_frequency"]
    """Agreement of held-out flights with a fit in frequency."""
    baseline_rls: Annotated[BaselineContent | None, "baseline"]
    handling_qualities: Annotated[list[HandlingPair], lambda a: _handling(a)]
    equation_error_start: Annotated[EquationErrorContent | None, "problem.first_guess"]
    starts: Annotated[list[StartRow], lambda a: _starts(a.fit)]
    """End of each start."""
    steps: Annotated[int, "fit.steps"]
    """Steps of the optimiser to the best optimum."""
    findings: Annotated[list[Finding], "fit.findings"]
    """Findings on the record, the model and the fit, the most severe first."""
    timing_s: Annotated[dict[str, float], "fit.timing"]
    """Time of each stage, and in total."""
    versions: Annotated[dict[str, str], lambda _: versions()]
    """Versions of Python and the libraries."""
    data: Annotated[list[FlightSource], lambda a: map(_flight, a.problem.flights)]
    inputs: Annotated[list[dict[str, HoldContent]], lambda a: map(_holds, a.problem.flights)]
    """Holds by flight and input."""
    seed: Annotated[int, "fit.seed"]


ADDED_KEYS: dict[type, type] = {
    Estimate: Fixed,
    Feedback: FeedbackToo,
    ResponseAgreement: ResponsesToo,
    Number: QualityToo,
    HandlingPair: HandlingToo,
}
"""Additional keys of a class, or other sources of its fields."""


def _whiteness_note(fit: Fit) -> str:
    return next((f.sentence for f in fit.findings if f.code in (COLOURED, TOO_NARROW)), "")


# Values that are not attributes: a mapping holds the keys of the file. An analysis is
# `heli_jax.report.files.Analysis`, which imports this module.


def _shown(estimates: Mapping[str, Estimate], status: Status) -> dict[str, Any]:
    """Return the estimates, without values of parameters that are not identifiable."""
    # A value along a null direction is arbitrary. Values of a fit that did not converge are kept,
    # because another fit may start from them.
    none: dict[str, Any] = dict.fromkeys(("value", "sd_white", "sd_alone"))
    converged = status != "not-converged"
    return {
        n: e._replace(**none) if converged and e.sd is None else e for n, e in estimates.items()
    }


def _adequate(fit: Fit) -> bool | None:
    return None if fit.status == "not-converged" else fit.adequate


def _parameters(analysis: Any) -> dict[str, Any]:
    fit = analysis.fit
    return _fixed(analysis.problem) | _shown(fit.estimates, fit.status)


def _fixed(problem: Problem) -> dict[str, Any]:
    """Return the parameters that flights state."""
    return {
        n: {"value": [f.known.get(n) for f in problem.flights], "fixed": True}
        for n in sorted({n for f in problem.flights for n in f.known})
    }


def _constants(fit: Fit, problem: Problem) -> dict[str, float]:
    """Return the constants of the vehicle that no flight states [SI]."""
    others = {*fit.estimates, *fit.nuisance, *_fixed(problem)}
    params = {n: np.asarray(v) for n, v in naming.asdict(fit.params).items() if n not in others}
    # Parameters of a user's model may be arrays.
    return {n: float(v) for n, v in params.items() if v.size == 1 and v.dtype.kind in "fiu"}


def _starts(fit: Fit) -> list[StartRow]:
    """Return the end of each start; None for undetermined values."""
    shown = _shown(fit.estimates, fit.status)
    open_ones: dict[str, Any] = {n: None for n, e in shown.items() if e.value is None}
    return [
        row._replace(end={n: open_ones.get(n, v) for n, v in row.end.items()}) for row in fit.starts
    ]


def _methods(compared: MethodComparison) -> dict[str, Any]:
    """Return the estimates by method, and their differences from the first."""
    results = {}
    for r in compared.results:
        found = {n: e for n in compared.names if (e := compared.estimate(r, n)) is not None}
        results[r.method] = {
            "status": "refused" if r.fit is None else r.fit.status,
            "verdict": r.word,
            "reason": r.reason or None,
            "seconds": r.seconds,
            "parameters": _shown(found, "converged"),
            "difference_joint_sd": {n: compared.difference(r, n) for n in found},
            "findings": () if r.fit is None else r.fit.findings,
        }
    return results


def _handling(analysis: Any) -> list[dict[str, Any]]:
    responses = analysis.supplementary.responses
    return handling_content(responses.handling if responses else ())


def handling_content(entries: Sequence[Handling]) -> list[dict[str, Any]]:
    """Return handling qualities of model and data by response, in SI, deg and dB."""
    mappings = [
        {**h.pair._asdict(), "model": _qualities(h.model), "data": _qualities(h.data)}
        for h in entries
    ]
    return written(list[HandlingPair], mappings)


def _qualities(of: HandlingQualities | str | None) -> dict[str, Any] | None:
    if of is None or isinstance(of, str):
        return None if of is None else {"numbers": {}, "sentences": [of]}
    # A value that is not determined is null.
    known = {name: n for name, n in of.numbers.items() if n.known}
    numbers = {
        name: {**known[name]._asdict(), "unit": UNITS[name]} if name in known else None
        for name in NUMBERS[of.kind]
    }
    return {"numbers": numbers, "sentences": of.sentences, "sign": of.sign, "band_rad_s": of.band}


def _flight(flight: Flight) -> dict[str, Any]:
    source = flight.source
    content = {
        "path": source.path if source else None,
        "sha256": source.sha256 if source else None,
        "flight": flight.name,
        "hold_out": flight.hold_out,
        "n_samples": flight.n_samples,
        "dt": flight.dt,
    }
    if source is None:
        return content
    return content | {
        "window": flight.window,
        "log_first_time": source.first_time,
        "notes": source.notes,
        "signals": {
            "inputs": {n: as_content(s) for n, s in source.inputs.items()},
            "outputs": {n: as_content(s) for n, s in source.outputs.items()},
        },
    }


def _holds(flight: Flight) -> dict[str, dict[str, str]]:
    """Return the hold of each input, with its reason."""
    reason = flight.hold_reason
    return {n: {"hold": h, "reason": reason.get(n, "as stated")} for n, h in flight.hold.items()}


class _Section(BaseModel):
    """Base of a section's pydantic model, made from a mapping or an object.

    Additional keys are allowed, because another version may have other keys.
    """

    model_config = ConfigDict(extra="allow", arbitrary_types_allowed=True, protected_namespaces=())
    section: ClassVar[Any] = None
    sources: ClassVar[dict[str, Callable[[Any], Any]]] = {}

    @model_validator(mode="before")
    @classmethod
    def _collected(cls, value: Any) -> Any:
        if not isinstance(value, Mapping):
            found = {n: source(value) for n, source in cls.sources.items()}
            value = {n: v for n, v in found.items() if v is not ABSENT}
        return plain(value)


@functools.cache
def model_of(section: Any) -> type[_Section]:
    """Return the pydantic model of a section, or of a class whose fields are keys."""
    fields = _fields(section)
    made = {n: (_type(kind) | None, None) for n, (kind, _) in fields.items()}
    model = create_model(section.__name__, __base__=_Section, **made)  # type: ignore[call-overload]
    model.section, model.sources = section, {n: source for n, (_, source) in fields.items()}
    return model


def _as_tuple(value: Any) -> Any:
    # JSON has only lists, and strict validation does not accept a list for a tuple.
    return tuple(value) if isinstance(value, list) else value


_NUMBERS = Annotated[Any, WithJsonSchema({"type": "array", "items": {"type": "number"}})]
"""An array of any shape."""


@functools.cache
def _type(kind: Any) -> Any:
    """Return the type by which pydantic checks a kind of value; null may replace any number."""
    origin, items = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return functools.reduce(operator.or_, map(_type, items))
    if kind in (bool, int, float, str):
        return kind | None
    if kind is type(None) or origin is Literal:
        return None if origin is None else kind
    if typing.is_typeddict(kind) or (isinstance(kind, type) and hasattr(kind, "_fields")):
        return model_of(kind)
    if origin in (dict, Mapping):
        return dict[str, _type(items[1])]
    if origin is tuple and Ellipsis not in items:
        numbers = tuple[tuple(map(_type, items))]  # type: ignore[misc]
        return Annotated[numbers, BeforeValidator(_as_tuple)]
    if origin in (list, tuple, Sequence):
        return list[_type(items[0])]
    return _NUMBERS


@functools.cache
def _fields(section: Any) -> dict[str, tuple[Any, Callable[[Any], Any]]]:
    """Return by key its kind and the source of its value."""
    hints = typing.get_type_hints(section, include_extras=True)
    if section in ADDED_KEYS:
        hints |= typing.get_type_hints(ADDED_KEYS[section], include_extras=True)
    fields = {}
    for name, kind in hints.items():
        source: Any = name
        if typing.get_origin(kind) is Annotated:
            kind, source = typing.get_args(kind)
        fields[name] = kind, source if callable(source) else operator.attrgetter(source)
    return fields


def written(kind: Any, value: Any) -> Any:
    """Return a value as plain data for JSON; a number that is not finite becomes None.

    Args:
        kind: a section, or a mapping or list of sections.
        value: an object with the sources of the keys, or a mapping of the keys.
    """
    adapter = TypeAdapter(_type(kind))
    made = adapter.validate_python(value)
    return plain(adapter.dump_python(made, exclude_unset=True))


def plain(value: Any) -> Any:
    """Return plain data for JSON, with records unchanged; None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray | map) and not hasattr(value, "_fields"):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def checked(data: bytes) -> dict[str, Any]:
    """Return the content of a fit.json, with missing or additional keys allowed.

    Raises:
        ValueError: it is no JSON object, or a value has the wrong kind.
    """
    try:
        model_of(FitFile).model_validate_json(data, strict=True)
    except ValidationError as e:
        first = e.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(f"{place}: {first['msg']}, got {str(first['input'])[:40]}") from None
    return json.loads(data)


def fit_keys() -> list[Key]:
    """Return all keys, each before its inner keys."""
    schema = model_of(FitFile).model_json_schema()
    parts = {**schema["$defs"], FitFile.__name__: schema}
    for model in _Section.__subclasses__():
        section = model.section
        added = naming.texts(ADDED_KEYS[section]) if section in ADDED_KEYS else {}
        for name, text in {**naming.texts(section), **added}.items():
            parts[model.__name__]["properties"][name]["description"] = text
    # These have the keys of `verdict`.
    again = ("verdict_before.", "determined_combinations[].")
    keys = (key for key in keys_of(schema) if not key.path.startswith(again))
    # Every key may be missing in the file of another version.
    return [key._replace(default="") for key in keys]
