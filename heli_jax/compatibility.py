"""Compatibility of a log's sensors: rates against angles, accelerations against velocities.

A layer over `run_fit` with the models of `heli_jax.dynamics.kinematics`. It uses the same
estimator, intervals and report, and adds a result for each sensor error and a file of corrections.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import naming, run_directory, workflow
from heli_jax.config.experiment import Experiment
from heli_jax.config.kinematics import NOISES, SIZES
from heli_jax.dynamics.kinematics import FORCES, RATES, is_kinematic
from heli_jax.errors import InputError
from heli_jax.finding import Finding, without_repeats
from heli_jax.identification.diagnostics.search import FAR
from heli_jax.identification.result import Estimate
from heli_jax.numbers import with_sd
from heli_jax.report.files import SensorAgreement
from heli_jax.workflow import FitRun, Say
from heli_jax.yaml_file import as_yaml

FILE = "compatibility.yaml"

AGREES = 0.9
"""Least R^2 of a channel whose sensors agree (the gate of the acceptance card)."""
_AS_SHOWN = 1.5
"""Largest ratio of estimated drift noise to the sensors' own noise that still counts as sensor
noise. A wrong unit or sign gives a far larger ratio.
"""
_RESTS = 0.5
"""Share of the priors in the variance of an error above which the record does not determine it."""
_NO_NOISE = 1e-9
"""Noise that counts as zero [fraction of the signal]. No log has that resolution."""
_LARGEST_SCALE = 0.1
"""Largest plausible scale error of a sensor. Cheap sensors are accurate to some percent."""


@dataclass(frozen=True)
class SensorError:
    """One sensor error and its estimate."""

    name: str
    meaning: str
    estimate: Estimate
    determined: bool

    @property
    def shows(self) -> bool:
        """True if the record determines the error and its interval excludes zero."""
        low, high = self.estimate.lower95, self.estimate.upper95
        return self.determined and low is not None and high is not None and low * high > 0

    @property
    def words(self) -> str:
        """Text of the error's row in the table."""
        if not self.determined:
            return "unknown"
        return "yes" if self.shows else "no"


@dataclass(frozen=True)
class Compatibility:
    """Agreement of a log's sensors with each other."""

    run: FitRun
    errors: tuple[SensorError, ...]
    r_squared: dict[str, float]
    """R^2 of each output, reconstructed from the corrected rates and specific forces."""
    compatible: bool
    verdict: str
    doubts: tuple[Finding, ...]
    """Findings that question the estimates."""
    corrections: dict[str, Any]
    """Content of `compatibility.yaml`."""


def run_compatibility(
    config: str | Path,
    out: str | Path | None = None,
    *,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    progress: Say = print,
) -> Compatibility:
    """Compare the sensors of a configuration's flights.

    Args:
        config: a configuration with `model: kinematics`.
        out: directory for the report and compatibility.yaml, a numbered sibling if it exists;
            default: nothing is written.
        overrides: replacements for values of the file (see `load_config`).
        progress: called with progress messages.

    Raises:
        InputError: a log or the configuration is wrong, or `out` cannot be written.
    """
    if out is not None:
        out = run_directory.free_directory(Path(out))
    experiment = workflow.load_config(config, overrides)
    if not is_kinematic(experiment.model):
        raise InputError(
            f"{config}: model: expected kinematics, which compares sensors with each other, got "
            f"{experiment.model.name} (docs/compatibility.md)"
        )
    run = workflow.run_fit(experiment, progress=progress)
    compatibility = judged(run)
    if _without_noise(run):
        words = _SMOOTH if _smooth(run) else _BEYOND_NOISE
        reason = Finding("sensors.noise-not-told", "doubt", words)
        progress("filter error did not converge: fitted again by output error")
        compatibility = judged(
            workflow.run_fit(_by_output_error(experiment), progress=lambda _: None)
        )
        compatibility = dataclasses.replace(compatibility, doubts=(reason, *compatibility.doubts))
        run = compatibility.run
    if out is None:
        return compatibility
    progress("writing the report")
    further = run.supplementary._replace(sensors=_agreement(compatibility))
    run = workflow.write_report(dataclasses.replace(run, supplementary=further), out)
    assert run.directory is not None
    place = run.directory / FILE
    with run_directory.whole_file(place, f"--out {place}") as part:
        part.write_text(as_yaml(compatibility.corrections), encoding="utf-8")
    return dataclasses.replace(compatibility, run=run)


def _agreement(compatibility: Compatibility) -> SensorAgreement:
    """Return the sensor results for the top of the fit's page."""
    head, rows = table(compatibility)
    # The fit's page already shows the fit's findings.
    doubts = tuple(d for d in compatibility.doubts if d not in compatibility.run.fit.findings)
    return SensorAgreement(
        compatibility.compatible, compatibility.verdict, doubts, head, tuple(rows)
    )


_SMOOTH = (
    "The log is smoother than white noise (low-pass filtered before logging?), so that the noise "
    "of gyros and angles cannot be estimated. Fitted by output error, with intervals from the "
    "autocorrelation of the residuals."
)
_BEYOND_NOISE = (
    "Filter error, which also estimates the noise, did not converge: these errors and noise do "
    "not explain the differences. Fitted by output error."
)


def _without_noise(run: FitRun) -> bool:
    """True if filter error estimated measurement noise as zero."""
    searched = {*NOISES} & {*run.problem.free}
    return (
        run.problem.noise_model == "disturbance"
        and bool(searched)
        and run.fit.status == "not-converged"
    )


def _smooth(run: FitRun) -> bool:
    """True if the estimated noise of an output is zero."""
    sizes = [np.nanstd(y) for s in run.fit.signals for y in s.measured.values()]
    return min(run.fit.noise.values(), default=1.0) < _NO_NOISE * max(sizes, default=0.0)


def _by_output_error(experiment: Experiment) -> Experiment:
    config = experiment.config
    assert config.fit is not None  # the experiment has been fitted
    fit = config.fit.model_copy(update={"method": "output-error"})
    return experiment._replace(config=config.model_copy(update={"fit": fit}))


def judged(run: FitRun) -> Compatibility:
    """Return the sensor compatibility from the fit of a kinematic model."""
    errors = tuple(_error(run, n, e) for n, e in run.fit.estimates.items() if n in SIZES)
    r_squared = r_squared_of(run)
    converged = run.fit.status != "not-converged"
    low = [n for n, r in r_squared.items() if not r >= AGREES]
    drifting = [n for n in low if n in _drifting(run)] if converged else []
    bad = [n for n in low if n not in drifting]
    compatible = converged and not bad
    verdict = _verdict(errors, r_squared, bad, drifting, converged)
    if compatible:
        verdict = f"{verdict}{_undetermined_words(run, errors)}"
    # If the signals are incompatible, the model is wrong and its errors are no corrections.
    known = {e.name: e.estimate.value for e in errors if e.determined and compatible}
    corrections = _corrections(run, known, errors)
    corrections["verdict"] = verdict
    doubts = _doubts(run, errors)
    return Compatibility(run, errors, r_squared, compatible, verdict, doubts, corrections)


def _error(run: FitRun, name: str, estimate: Estimate) -> SensorError:
    verdict = run.fit.verdict
    rests = name in verdict.resting or estimate.prior_share > _RESTS
    determined = estimate.sd is not None and not rests and run.fit.status != "not-converged"
    return SensorError(name, naming.meaning(run.config.model.Params, name), estimate, determined)


def r_squared_of(run: FitRun) -> dict[str, float]:
    """Return the R^2 of each output over all fitted flights; NaN where an output never moves.

    R^2 is 1 - the squared residual over the squared deviation from the mean.
    """
    shares = {}
    flights = [s for s in run.fit.signals if not s.hold_out]
    for n in sorted({n for s in flights for n in s.measured}):
        left = total = 0.0
        for s in flights:
            if n in s.measured:
                y = s.measured[n]
                left += float(np.nansum((y - s.simulated[n]) ** 2))
                total += float(np.nansum((y - np.nanmean(y)) ** 2))
        shares[n] = 1.0 - left / total if total > 0 else float("nan")
    return shares


def _drifting(run: FitRun) -> set[str]:
    """Return the outputs whose one-step predictions attribute the drift to the sensors' noise."""
    fit = run.fit
    if run.problem.noise_model != "disturbance":
        return set()
    for n in {*NOISES} & {*fit.estimates}:
        # The start value is the noise estimated from third differences.
        if not fit.estimates[n].value <= _AS_SHOWN * run.problem.free[n].start:
            return set()
    ratios = {
        o.output: o.against_disturbance for o in fit.adequacy.judged if o.adequate and o.white
    }
    return {n for n, ratio in ratios.items() if ratio is not None and ratio <= _AS_SHOWN**2}


def _verdict(
    errors: Sequence[SensorError],
    r_squared: dict[str, float],
    bad: Sequence[str],
    drifting: Sequence[str],
    converged: bool,
) -> str:
    if not converged:
        return "No result: the optimiser did not converge."
    if bad:
        channels = ", ".join(f"{n} (R2 {r_squared[n]:.3f})" for n in bad)
        return (
            f"Not compatible: no sensor errors of these kinds bring {channels} to R2 {AGREES:g}. "
            "Check for a wrong unit, sign or axis, a filter, or a scale that changes during the "
            "flight."
        )
    lowest = min([r for n, r in r_squared.items() if n not in drifting] or r_squared.values())
    agree = f"R2 {lowest:.4f} or more"
    if drifting:
        channels = ", ".join(f"{n} (R2 {r_squared[n]:.3f})" for n in drifting)
        agree += f", except for {channels}, which drift no further than sensor noise explains"
    shown = [e.name for e in errors if e.shows]
    if not shown:
        return f"Compatible as logged: {agree}, and no significant sensor error."
    return f"Compatible once {', '.join(shown)} are corrected: {agree}."


def _undetermined_words(run: FitRun, errors: Sequence[SensorError]) -> str:
    """Return what these channels cannot determine if the verdict is good; empty if they determine
    all.
    """
    untold = [e for e in errors if not e.determined]
    if not untold:
        return ""
    # An error without bounds can hide any misfit, if it is large enough.
    priors = {e.name: run.problem.free[e.name].prior for e in untold}
    far = [
        f"{e.name} of {e.estimate.value:+.2g} {e.estimate.unit}".removesuffix(" 1").rstrip()
        for e in untold
        if (prior := priors[e.name]) and abs(e.estimate.value - prior.mean) > FAR * prior.sd
    ]
    if far:
        return (
            f" This needs {', '.join(far)}, which is implausible for a sensor and which these "
            "channels do not determine: the signals may contradict each other."
        )
    return f" These channels do not determine {', '.join(e.name for e in untold)}."


def _doubts(run: FitRun, errors: Sequence[SensorError]) -> tuple[Finding, ...]:
    """Return the fit's own doubts, and implausible sensor errors."""
    # The verdict covers channels that the simulation misses. The remedies of these findings are for
    # vehicles.
    of_model = ("adequacy.", "dynamics.", "excitation.")
    notes = without_repeats(
        f for f in run.fit.findings if f.severity != "ok" and not f.code.startswith(of_model)
    )
    scales = [
        e
        for e in errors
        if e.shows and e.name.startswith("lambda_") and abs(e.estimate.value) > _LARGEST_SCALE
    ]
    if not scales:
        return tuple(notes)
    each = ", ".join(f"{e.name} {100 * e.estimate.value:+.0f} %" for e in scales)
    words = (
        f"{each}: larger than the error of a sensor. Check the unit, filters on one of the two "
        "signals, and whether the angle is the vehicle's or an estimator's. These values make "
        "the signals agree; they do not show which signal is wrong."
    )
    largest = max((e.estimate.value for e in scales), key=abs)
    criterion = f"scale error, {_LARGEST_SCALE:g}"
    names = tuple(e.name for e in scales)
    return (Finding("sensors.scale-too-large", "doubt", words, largest, criterion, names), *notes)


def _corrections(
    run: FitRun, values: dict[str, float], errors: Sequence[SensorError]
) -> dict[str, Any]:
    """Return the content of a file of corrections: `signals` and `known` of another configuration.

    A sensor shows (1 + lambda) truth + b, so its number is converted with another scale and offset.
    """
    experiment = run.config
    # The earliest sensor needs no correction. Delays are relative to it.
    by_sensor = {"delay_gyro": RATES, "delay_accel": FORCES}
    early = {n: values.get(p, 0.0) for p, names in by_sensor.items() for n in names}
    latest = max(0.0, *early.values())
    lines = dict(experiment.model.delay_lines)
    signals: dict[str, Any] = {}
    sources = [f.source for f in reversed(run.problem.flights) if f.source is not None]
    read = {n: s for source in sources for n, s in {**source.inputs, **source.outputs}.items()}
    for n, signal in read.items():
        late = latest - early[n] if n in early else latest + values.get(lines.get(n, ""), 0.0)
        scale, bias = values.get(f"lambda_{n}", 0.0), values.get(f"b_{n}", 0.0)
        # A constant is stated, not measured.
        if signal.constant is None and (scale or bias or _short(late)):
            # The bias in the log's own numbers is independent of scale and sign.
            conversion = {
                "scale": _short(signal.scale / (1.0 + scale)),
                "offset": _short(float(signal.from_si(np.asarray(bias)))),
                **({"invert": True} if signal.invert else {}),
                **({"delay": _short(late)} if _short(late) else {}),
            }
            signals[n] = {"signal": signal.name, "unit": signal.unit, **conversion}
    return {
        "found_by": f"heli-jax compatibility {experiment.path.name}",
        "signals": signals,
        "known": {n: _short(values[n]) for n in ("x_imu", "y_imu", "z_imu") if n in values},
        "not_determined": [e.name for e in errors if not e.determined],
    }


def _short(value: float) -> float:
    # Five digits are readable, and more than any record determines.
    return float(f"{value:.5g}")


def table(compatibility: Compatibility) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the head and rows of the table of errors."""
    head = ("error", "estimate, 95 %", "unit", "shows", "what it is")
    rows = []
    for e in compatibility.errors:
        interval, estimate = "", e.estimate
        if e.determined and estimate.lower95 is not None and estimate.upper95 is not None:
            reach = max(estimate.upper95 - estimate.value, estimate.value - estimate.lower95)
            interval = with_sd(estimate.value, reach)
        rows.append((e.name, interval, estimate.unit, e.words, e.meaning))
    return head, rows
