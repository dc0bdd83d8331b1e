"""What fit.json holds, as classes: of its own, and those of the package whose fields it has.

A number that is not finite is null in the file, whatever its kind.
"""

from typing import Literal, TypedDict

from heli_jax.analysis.attitude_responses import HandlingPair
from heli_jax.analysis.handling_qualities import Number
from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Distrust, Finding
from heli_jax.identification.equation_error.first_guess import Equation, StartValue
from heli_jax.identification.equation_error.stepwise import Step
from heli_jax.identification.estimation.multistart import StartRow
from heli_jax.identification.identifiability.verdict import Combination, Pair
from heli_jax.identification.model_selection import Candidate, Nested
from heli_jax.identification.result import Estimate, Status
from heli_jax.identification.uncertainty.nuts import Convergence
from heli_jax.identification.uncertainty.profile_likelihood import Profile
from heli_jax.identification.validation.advice import OutputAdequacy
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.identification.validation.held_out_agreement import HeldOutFrequency
from heli_jax.identification.validation.metrics import Metrics, Whiteness
from heli_jax.report.card import Gate


class VerdictContent(TypedDict):
    """What the data determine, with all that it was read off."""

    text: str
    """in a sentence"""
    identifiable: bool
    """whether they determine every free parameter"""
    rank: int
    """directions that are determined, priors included"""
    rank_without_priors: int
    condition_number: float
    singular_values: list[float]
    """of the whitened sensitivities in relative coordinates: one over the sd of a direction"""
    null_directions: list[dict[str, float]]
    """by parameter, in relative coordinates, along which nothing changes"""
    determined_combinations: list[Combination]
    """what is determined where not every parameter is"""
    strong_pairs: list[Pair]
    """parameters that the data hardly tell apart"""
    without_effect: list[str]
    """parameters that no output shows"""
    resting_on_priors: list[str]
    """parameters that the priors determine, and not the data"""
    exchangeable_nuisances: list[str]
    """nuisances, as `flight 1/bias p`, that make up for what is not determined"""
    other_solutions: list[dict[str, float]]
    """other values of the free parameters that fit as well [SI]"""
    names: list[str]
    """the order of `correlation` and `covariance_log`"""
    correlation: list[list[float]]
    covariance_log: list[list[float]]
    """in relative coordinates (a logarithm, or the value over a scale); what is not determined is
    left out of it"""


class AdequacyAgainst(TypedDict):
    """The limits of the version that wrote the file."""

    explained_at_least: float
    or_other_than_white_noise_at_most: float
    or_power_over_what_the_disturbance_makes_at_most: float


class AdequacyContent(TypedDict):
    """Whether the model explains the record."""

    summary: str
    """the answer in a few words, as the first line has it"""
    judged: list[OutputAdequacy]
    by_chance: bool
    """whether nothing measured stands out of the noise, so that any optimum is one of chance"""
    ahead: float | None
    """[s] that is predicted at most where that, and no simulation, was judged"""
    against: AdequacyAgainst


class Fixed(TypedDict):
    """Beside the fields of the class."""

    value: float | list[float] | None
    """the estimate; null where it is not determined; of what flights state a number of each"""
    fixed: bool
    """whether flights state it, and it was not free; then there is nothing else"""


class Residuals(TypedDict):
    """What is left of the measurements."""

    white: bool
    overconfident: bool
    """whether intervals count samples as news that repeat each other"""
    note: str
    """what follows where they are not white"""
    by_output: dict[str, Whiteness]
    """by `flight/output`; under filter error of the innovations"""


class FeedbackToo(TypedDict):
    """Beside the fields of the class."""

    present: bool
    """whether the input follows the response: the p value is below the level"""
    level: float


class ResponsesToo(TypedDict):
    """Beside the fields of the class."""

    averages: dict[str, float]
    """independent ones by output"""
    usual_J: float
    """Tischler's limit of a good fit"""


class CandidatesCompared(TypedDict):
    """Models compared."""

    candidates: list[Candidate]
    """best AIC first"""
    nested: list[Nested]
    """likelihood-ratio tests"""
    sentences: list[str]


class MethodResult(TypedDict):
    """The same problem by a method."""

    status: str
    """as above, or refused"""
    verdict: str
    reason: str | None
    """why it was refused, or is no result"""
    seconds: float
    parameters: dict[str, Estimate]
    difference_joint_sd: dict[str, float]
    """from the first method's estimate, in their joint standard deviation"""
    findings: list[Finding]


class MethodsCompared(TypedDict):
    """Methods side by side."""

    results: dict[str, MethodResult]
    sentences: list[str]


class Nuts(TypedDict):
    """Whether the draws may be believed."""

    rhat: float
    """the largest"""
    effective: float
    """independent draws, the fewest"""
    divergent: int
    trusted: bool
    by_parameter: dict[str, Convergence]


class IntervalsContent(TypedDict, total=False):
    """95 % intervals by several methods."""

    by_parameter: dict[str, dict[str, list[float]]]
    """by parameter and method (gaussian, profile, bootstrap, nuts) both ends"""
    profiles: dict[str, Profile]
    sentences: list[str]
    bootstrap_failures: int
    """of a bootstrap: refits that did not arrive"""
    nuts: Nuts
    """of NUTS"""


class Compatibility(TypedDict):
    """Of `heli-jax compatibility`."""

    compatible: bool
    verdict: str
    doubts: list[Finding]
    shows: dict[str, str]
    """by error of a sensor whether it shows"""


class Continuous(TypedDict):
    """The transfer function of the recursive least squares."""

    num: list[float]
    """coefficients, highest power of s first"""
    den: list[float]
    exact: bool
    """whether it is that of the discrete one with a zero-order hold"""
    note: str


class BaselineContent(TypedDict):
    """The recursive least squares, from an input to an output of one flight."""

    flight: str
    input: str
    output: str
    order: int
    forgetting: float
    theta: list[float]
    """coefficients of the difference equation"""
    poles: list[list[float]]
    """real and imaginary part of each"""
    continuous: Continuous
    combinations: dict[str, float]
    """of the paper's equation 23"""
    metrics: dict[str, Metrics]
    """of its simulation"""
    trusted: bool
    sentences: list[str]


class QualityToo(TypedDict):
    """Beside the fields of the class."""

    unit: str


class Qualities(TypedDict, total=False):
    """What a response says, of the model or of the data."""

    numbers: dict[str, Number | None]
    """by name; null is not determined"""
    sentences: list[str]
    sign: int
    """-1 where the response was turned over"""
    band_rad_s: list[float]
    """in which it is known"""


class HandlingToo(TypedDict):
    """Beside the fields of the class."""

    model: Qualities | None
    data: Qualities | None
    """null where no response was asked for"""


class Stepwise(TypedDict):
    """The terms that stepwise regression chose."""

    selected: list[str]
    steps: list[Step]
    f_ratios: dict[str, float]


class EquationErrorContent(TypedDict):
    """First guesses by equation error."""

    values: dict[str, StartValue]
    equations: list[Equation]
    smoothing_half_width_s: float
    not_measured: list[str]
    """states that nothing measured shows"""
    stepwise: Stepwise | None
    sentences: list[str]


class FrequencyErrorContent(TypedDict):
    """First guesses by frequency error."""

    status: Status
    seconds: float
    values: dict[str, StartValue]
    sentences: list[str]
    notes: list[str]


class SignalSource(TypedDict, total=False):
    """Where a signal of the model came from."""

    signal: str
    """the channel of the log; without one a constant stands there"""
    constant: float
    unit: str
    scale: float
    offset: float
    invert: bool
    origin: str
    """what was made of it on the way, in words"""


class SignalSources(TypedDict):
    """By name of the model's signal."""

    inputs: dict[str, SignalSource]
    outputs: dict[str, SignalSource]


class FlightSource(TypedDict, total=False):
    """Where a flight came from; one that was given in memory has no path and no signals."""

    path: str | None
    sha256: str | None
    """of the whole file"""
    flight: str
    hold_out: bool
    """whether it served for validation alone"""
    n_samples: int
    dt: float
    """[s]"""
    window: list[float]
    """[s] from the log's beginning"""
    log_first_time: float
    """[s] in the log's own count"""
    notes: list[Finding]
    """what the reader of the log assumed or did"""
    signals: SignalSources


class HoldContent(TypedDict):
    """What an input does between samples."""

    hold: Literal["zero-order", "linear", "mixed"]
    reason: str


class FitFile(TypedDict):
    """fit.json."""

    status: Status
    """whether the optimiser converged, and whether the data determine what was asked"""
    exit_code: Literal[0, 3, 4]
    """0: the intervals may be used; 3: not identifiable, or not trusted; 4: not converged, or not
    adequate"""
    model: str
    method: str
    instruments: list[str]
    """inputs that were taken by a logged excitation"""
    n_samples: int
    """measured numbers that were fitted"""
    identifiable: bool
    """whether the data and the priors determine every free parameter"""
    adequate: bool | None
    """whether the model explains the record; null where that was not judged"""
    adequacy: AdequacyContent
    null_directions: list[dict[str, float]]
    """as in `verdict`"""
    determined_combinations: list[Combination]
    """as in `verdict`"""
    verdict: VerdictContent
    """at the estimates"""
    verdict_before: VerdictContent
    """at the start values"""
    parameters: dict[str, Estimate]
    """the free ones, and those that flights state [SI]"""
    constants: dict[str, float]
    """the vehicle's numbers that the fit took as known [SI]"""
    nuisance: dict[str, Estimate]
    """gains, delays, disturbances, initial states, biases; of one flight as `flight/name`"""
    noise_sd: dict[str, float]
    """of the measurements, by `flight/output` [SI]"""
    metrics: dict[str, Metrics]
    """by output, of the flights that were fitted, simulated"""
    validation: dict[str, Metrics]
    """the same of flights held out"""
    validation_free_run: dict[str, Metrics]
    """the same in one piece, where windows were asked for"""
    one_step: dict[str, Metrics]
    """predicted one sample ahead, of the flights that were fitted"""
    one_step_validation: dict[str, Metrics]
    """the same of flights held out"""
    acceptance: list[Gate]
    """the lines of the acceptance card"""
    models: CandidatesCompared | None
    methods: MethodsCompared | None
    intervals: IntervalsContent | None
    record: list[Finding]
    """whether the log is enough"""
    compatibility: Compatibility | None
    log_likelihood: float
    unknowns: int
    """estimated numbers, those of the noise included"""
    aic: float
    bic: float
    covariance: Literal["white", "coloured residuals"]
    """what the intervals take the residuals for"""
    residuals: Residuals
    feedback: list[Feedback]
    """by flight and input that moves freely"""
    untrusted: dict[str, Distrust]
    """by parameter, why its interval may not be used"""
    distrust: str
    """the same in a sentence; empty where all is trusted"""
    responses: ResponseAgreement | None
    """of a fit of frequency responses"""
    held_out_frequency: HeldOutFrequency | None
    """of a fit in frequency what flights held out say there"""
    baseline_rls: BaselineContent | None
    handling_qualities: list[HandlingPair]
    equation_error_start: EquationErrorContent | None
    frequency_error_start: FrequencyErrorContent | None
    starts: list[StartRow]
    """where each start led"""
    steps: int
    """of the optimiser, to the best optimum"""
    findings: list[Finding]
    """about the record, the model and the fit"""
    timing_s: dict[str, float]
    """by what was done, and in all"""
    versions: dict[str, str]
    """of Python and the libraries"""
    data: list[FlightSource]
    inputs: list[dict[str, HoldContent]]
    """by flight and input"""
    seed: int


TOO: dict[type, type] = {
    Estimate: Fixed,
    Feedback: FeedbackToo,
    ResponseAgreement: ResponsesToo,
    Number: QualityToo,
    HandlingPair: HandlingToo,
}
"""what the file has beside the fields of a class, or in their place"""
