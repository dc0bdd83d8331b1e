"""Schema of a configuration: its sections, their keys and their bounds."""

import math
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from heli_jax.config.control_section import ControlConfig
from heli_jax.config.design_section import FlightDesignConfig
from heli_jax.config.disturbance_section import DisturbanceConfig
from heli_jax.config.frequency_section import FrequencyConfig
from heli_jax.config.onboard import Delay, Filters, OnboardConfig
from heli_jax.config.run_sections import SimulateConfig, SweepConfig
from heli_jax.config.section import Finite, Positive, Section
from heli_jax.config.signal_section import LoggedInputConfig, Numbers, PresetConfig, ScaledConfig
from heli_jax.identification.methods import METHODS
from heli_jax.identification.problem import Sign


# The records for scripts (`Free`, `Prior`, `Nuisance`) have separate sections with the same fields,
# as a test checks. One class for both would not work. For a NamedTuple, pydantic accepts lists,
# reports a misspelt key as an unexpected argument, and writes lists into the run's config.yaml.
# Records as pydantic classes would bring pydantic into the identification.
class LinearConfig(Section):
    """A model from a file (docs/linear-models.md)."""

    linear: str
    """path of the file, or the name of a shipped model"""


class TimeConfig(Section):
    signal: str | None = None
    """the column of time stamps, or with a rate one that counts samples"""
    unit: str = "s"
    """unit of the time stamps: s, ms, us or ns"""
    rate: Positive | None = None
    """samples a second [Hz] of a file without times: of its rows, or of the counts in `signal`"""
    runs: str | None = None
    """column that numbers the runs of a file with several; each run becomes a flight"""

    @model_validator(mode="after")
    def _one_clock(self) -> "TimeConfig":
        if self.signal is None and self.rate is None:
            raise ValueError(
                "expected either signal, the column of times, or rate, the samples per second"
            )
        if self.rate is not None and "unit" in self.model_fields_set:
            raise ValueError("unit: expected none with a rate, which already gives the sample time")
        return self


class InputConfig(LoggedInputConfig):
    unit: str | None = None
    """unit after scale and offset; default SI"""
    hold: Literal["auto", "zero-order", "linear", "mixed"] = "auto"
    """motion between samples (docs/inputs.md); auto: decided from the log"""
    missing: Numbers | None = None
    """numbers in the log, before scale and offset, that mean no value, one or a list; the input
    then keeps its previous value"""


class OutputConfig(ScaledConfig):
    signal: str
    """a channel's or column's name in the log"""
    unit: str | None = None
    """unit after scale and offset"""
    sd: Positive | None = None
    """standard deviation of its noise, in `unit`, if known"""
    filter: Filters | None = None
    """the autopilot's filters: from log, or one or several of {kind, hz, ...} (docs/onboard.md);
    [] for none"""
    delay: Delay | None = None
    """delay in the log [s]"""
    repeats: Literal["auto", "keep", "missing"] = "auto"
    """values that a logger repeats until the next sample (docs/logs.md)"""
    missing: Numbers | None = None
    """numbers in the log, before scale and offset, that mean no value, one or a list, such as 0 in
    a sensor's dropouts"""


class SignalsConfig(PresetConfig):
    time: TimeConfig | None = None
    """clock of a table; the topics of an autopilot's log have their own"""
    # Names are checked later, when the model's inputs and outputs are known.
    inputs: dict[str, InputConfig] = Field(default={})
    """the model's inputs, by its names"""
    outputs: dict[str, OutputConfig] = Field(default={})
    """the model's outputs, by its names"""
    instruments: dict[str, InputConfig] = Field(default={})
    """excitations by input that were added to it and that no feedback reaches
    (docs/frequency-fits.md)"""


class AlignConfig(Section):
    """A motion in both logs, from which the lag between their clocks is found."""

    # `with` is a keyword of Python, so the field has another name.
    same: Annotated[str, Field(alias="with")]
    """a signal of the first log, by the model's name"""
    to: str
    """the same motion in this log, in any unit"""
    reverse: bool = False
    """true for the opposite sign"""


class AlsoSignalsConfig(SignalsConfig):
    @model_validator(mode="after")
    def _by_name(self) -> "AlsoSignalsConfig":
        if self.preset is not None or self.ccpm is not None:
            raise ValueError("expected inputs and outputs by name in a further log, got a preset")
        if self.instruments:
            raise ValueError("instruments: expected them among the flight's own signals")
        return self


class AlsoConfig(Section):
    """A further log of the same flight (docs/logs.md)."""

    log: str
    """path of the file, relative to the configuration's folder"""
    align: AlignConfig | None = None
    """search for the lag of its clock; without it both logs share one clock"""
    signals: AlsoSignalsConfig
    """signals of this log"""
    flight: Annotated[int, Field(ge=1)] | None = None
    """number of the flight in a log of several, from 1"""


def _one_log(value: Any) -> Any:
    # A study removes the list beforehand; a list here comes from another command.
    if isinstance(value, list):
        raise ValueError(
            "expected one log, got a list, which makes a study of fits (heli-jax fit, "
            "heli_jax.run_study)"
        )
    return value


class FlightConfig(Section):
    log: Annotated[str, BeforeValidator(_one_log, json_schema_input_type=str | list[str])]
    """path of the file, relative to the configuration's folder; a list makes a study with a fit for
    each (docs/studies.md)"""
    signals: SignalsConfig
    """channels of the inputs and outputs"""
    flight: Annotated[int, Field(ge=1)] | None = None
    """number of the flight in a log of several, from 1"""
    name: str | None = None
    """name in tables and figures; default 'flight 1' and so on"""
    rate: Positive | None = None
    """rate to resample to [Hz]; default the log's own"""
    # The order is checked where logs are read, for configurations and scripts alike.
    window: tuple[Finite, Finite] | Literal["auto"] | None = None
    """first and last time [s] from the log's beginning; auto: the most informative windows"""
    gaps: Literal["fail", "split"] = "fail"
    """treatment of gaps too long to be bridged: fail, or split into flights"""
    also: list[AlsoConfig] = []
    """further logs of the same flight"""
    # Such a run is predicted and never fitted, so agreement with it is independent of the free
    # parameters.
    hold_out: bool = False
    """true: predict this flight, do not fit it"""
    known: dict[str, Finite] = {}
    """model parameters known for this flight only, in SI: {Ixx_added: 0.01}"""


class PriorConfig(Section):
    mean: Finite
    """mean of a normal distribution, in SI"""
    sd: Positive
    """standard deviation, in SI"""


class FreeConfig(Section):
    # NaN and not None, as in `Free`; defaults are not validated, values in the file are.
    start: Finite = math.nan
    """start value; not needed if the vehicle file has a value or `fit.start` finds one"""
    lower: Finite | None = None
    """bound, in SI"""
    upper: Finite | None = None
    """bound, in SI"""
    prior: PriorConfig | None = None
    """prior knowledge"""
    sign: Sign | None = None
    """keep the sign of the start value, or allow any sign; default keep for a helicopter's
    parameters, any for your own models"""


class NuisanceConfig(Section):
    initial_state: bool = True
    """true: estimate the initial state of each flight"""
    bias: bool = True
    """true: estimate a constant added to each output of each flight"""
    time_shift: bool = False
    """true: estimate a delay [s] of all inputs, negative if they were logged late"""
    input_gain: bool = False
    """true: estimate a factor of each input"""
    input_offset: bool | list[str] | None = None
    """estimate a constant added to the logged inputs, per flight: of all, or of those named; null:
    on for the sticks of a vehicle in free flight"""


class IntervalsConfig(Section):
    """Intervals besides the Gaussian ones."""

    profile: list[str] = []
    """free parameters for profile-likelihood intervals"""
    bootstrap: Annotated[int, Field(ge=0, le=100_000)] = 0
    """simulated records to refit; 0 for none"""
    nuts: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """draws of each of four chains (extra `bayes`); 0 for none"""


class ShootingConfig(Section):
    """Multiple shooting: windows with their own initial states."""

    window: Positive
    """length [s]"""
    continuity: Positive | None = None
    """sd of each state's defect between windows (matching condition), relative to the state's
    range; null: free"""


class FitConfig(Section):
    # From the table of estimators, so that a new one needs no entry here.
    method: Literal[tuple(METHODS)] = "output-error"  # pyright: ignore[reportInvalidTypeForm]
    """estimation method (docs/methods.md)"""
    also: list[Literal[tuple(METHODS)]] = []  # pyright: ignore[reportInvalidTypeForm]
    """further methods that fit the same problem, for comparison with `method`"""
    free: dict[str, FreeConfig]
    """parameters to estimate, by the model's names"""
    start: Literal["given", "equation-error"] = "given"
    """source of the start values: given; equation-error, a regression of the records, for linear
    models"""
    instrument: str | Annotated[list[str], Field(min_length=1)] | None = None
    """in frequency: inputs used by their instrument, or none; default all inputs with an instrument
    in every flight (docs/frequency-fits.md)"""
    nuisance: NuisanceConfig = NuisanceConfig()
    """nuisance parameters"""
    shooting: ShootingConfig | None = None
    """multiple shooting: windows with their own initial states"""
    starts: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """number of start points; default one, and restarts if a fit explains little"""
    seed: Annotated[int, Field(ge=0)] = 0
    """seed of random starts, bootstrap and NUTS"""
    max_steps: Annotated[int, Field(ge=1)] = 200
    """most steps of the optimiser from each start"""
    compare: bool = False
    """true: also fit candidate models: no disturbance, one pole, two poles; with several
    disturbances all, and each left out"""
    intervals: IntervalsConfig = IntervalsConfig()
    """intervals besides the Gaussian ones"""

    @property
    def by_instrument(self) -> tuple[str, ...] | None:
        """`instrument` as in `Problem`: () for none, None if not stated."""
        if self.instrument == "none":
            return ()
        if self.instrument is None:
            return None
        return (self.instrument,) if isinstance(self.instrument, str) else tuple(self.instrument)

    @model_validator(mode="after")
    def _other_methods(self) -> "FitConfig":
        for i, method in enumerate(self.also):
            if method == self.method or method in self.also[:i]:
                raise ValueError(f"also: expected methods beside {self.method}, got {method} again")
        return self


class RLSConfig(Section):
    # Four is the order in the paper.
    order: Annotated[int, Field(ge=1, le=20)] = 4
    """order of the discrete transfer function"""
    # With one, all samples count equally, as for a vehicle that does not change in a record.
    forgetting: Annotated[float, Field(gt=0, le=1)] = 1.0
    """factor by which each sample counts less than the next"""


class ReportConfig(Section):
    # A PNG takes half a second of each fit, and no page shows it.
    png: bool = False
    """true: write figures as PNG too, beside SVG"""


class Config(Section):
    """One experiment."""

    model: str | LinearConfig
    """a model's name, package.module:name, or {linear: FILE}"""
    # A file, or its constants; the readers of vehicle files check both.
    vehicle: str | dict[str, Any] | None = None
    """vehicle file, or its constants; optional if the model is a file, which has its own values"""
    corrections: dict[str, bool] | None = None
    """corrections of the paper's equations by name, on or off
    (`heli_jax.dynamics.helicopter.Corrections`); full helicopter only"""
    onboard: OnboardConfig | None = None
    """servos, rate loops, gyro, sensors and delays around the model (docs/onboard.md)"""
    controller: str | None = None
    """run directory of `heli-jax control`, or its control.json: the model is flown by this
    controller, and its gains are parameters `controller_...` (docs/control.md)"""
    # Any: a number in SI or {value, unit}, as in a vehicle file. It is checked where the model's
    # units are known.
    initial_state: dict[str, Any] = {}
    """values of states at the first sample, in place of the model's own; for models that cannot
    begin at zero"""
    # Optional: a simulation needs none.
    flights: list[FlightConfig] = []
    """the logged runs"""
    fit: FitConfig | None = None
    """estimation"""
    # On by default: the paper's baseline takes little time.
    rls: RLSConfig | None = RLSConfig()
    """recursive least squares of the paper, besides the fit; null for none"""
    disturbance: DisturbanceConfig | None = None
    """random disturbances: drawn by simulate, estimated by filter error"""
    frequency: FrequencyConfig | None = None
    """settings of `heli-jax frf` and of fit.method: frequency-response (docs/frequency-fits.md)"""
    report: ReportConfig = ReportConfig()
    """files besides the page of `fit` and `frf`"""
    simulate: SimulateConfig | None = None
    """a run that `heli-jax simulate` makes"""
    sweep: SweepConfig | None = None
    """many runs, for `heli-jax sweep`"""
    design: FlightDesignConfig | None = None
    """inputs that `heli-jax design` computes"""
    control: ControlConfig | None = None
    """controller that `heli-jax control` computes"""
    study: dict[str, list[Any]] | None = None
    """lists of values by key in a study of fits: every combination (docs/studies.md)"""
