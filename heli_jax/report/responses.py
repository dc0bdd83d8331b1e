"""Files of `heli-jax frf`: responses as CSV, transfer functions, figures, a page."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.analysis.attitude_responses import Handling
from heli_jax.analysis.flight_responses import FlightResponses, Pair, TransferRequest, decays_within
from heli_jax.analysis.spectra import COHERENT
from heli_jax.analysis.transfer_fit import Coefficient, TransferFit
from heli_jax.flights.write import write_table
from heli_jax.numbers import NOTHING, number, with_sd
from heli_jax.report import tables
from heli_jax.report.charts import Chart, Numbers
from heli_jax.report.document import handling_content
from heli_jax.report.figures.bode import branch_of, draw_response, quotient, seen_of
from heli_jax.report.files import as_json
from heli_jax.report.origin import origin
from heli_jax.report.page import filled, picture
from heli_jax.report.tables import Table

_FILES = (
    "responses.csv",
    "transfer_functions.json",
    "handling_qualities.json",
)
_DB = 20.0 / np.log(10.0)
_SURE = 0.3
"""Largest relative random error of a usable response, that of five averages at coherence 0.6."""
_TOO_LARGE = 2.0
"""chi-squared per degree of freedom above which the order of a transfer function is too low."""


def write_responses(
    directory: Path,
    responses: FlightResponses,
    units: Mapping[str, str],
    title: str,
    handling: Sequence[Handling] = (),
    *,
    config: str = "",
    png: bool = False,
) -> None:
    """Write the files of responses, transfer functions and handling qualities, with figures and
    page.
    """
    write_table(directory / "responses.csv", table(responses))
    fits = [_content(*fit, responses.window) for fit in responses.fits]
    for name, content in (
        ("transfer_functions.json", fits),
        ("handling_qualities.json", handling_content(handling)),
    ):
        (directory / name).write_text(as_json(content) + "\n", encoding="utf-8")
    (directory / "figures").mkdir()
    numbers = Numbers()
    pictures = [
        picture(
            # Names of a model are Python names, so they are valid in file names.
            f"{name}-{input}",
            functools.partial(_draw, responses, units, input, name),
            numbers,
            folder=directory / "figures",
            png=png,
        )
        for name, output in responses.outputs.items()
        for input in output.pairs
    ]
    page = filled(
        "responses.html.j2",
        title=title,
        pictures=pictures,
        numbers=numbers.content(),
        origin=origin(config, _FILES),
        notes=responses.notes,
        fits=Table(
            ("input", "output", "averages", *FIT_HEAD),
            [
                (w.input, w.output, _averages(responses, w), *fit_row(fit))
                for w, fit in responses.fits
            ],
        ),
        fit_sentences=[
            f"{w.input} to {w.output}, {w.zeros} zeros, {w.poles} poles: {sentence}"
            for w, fit in responses.fits
            for sentence in fit_sentences(fit, responses.window)
        ],
        window=f"{responses.window:g}",
        handling=tables.handling(handling),
        handling_sentences=tables.handling_sentences(handling),
    )
    (directory / "responses.html").write_text(page, encoding="utf-8")


def _averages(responses: FlightResponses, request: TransferRequest) -> str:
    """Return the number of averages of a fitted response as text."""
    output = responses.outputs.get(request.output)
    return NOTHING if output is None else number(output.averages, 3)


def _draw(responses: FlightResponses, units: Mapping[str, str], input: str, output: str) -> Chart:
    measured = responses.outputs[output]
    curves = [
        (f"{w.zeros} zeros, {w.poles} poles", fit.sampled(responses.omega, responses.holds[input]))
        for w, fit in responses.fits
        if (w.input, w.output) == (input, output)
        and isinstance(fit, TransferFit)
        and fit.determined
    ]
    by = "by its instrument" if input in responses.instruments else "direct"
    note = f"{by}, windows of {responses.window:g} s, {measured.averages:.1f} independent averages"
    unit, pair = quotient(units[output], units[input]), measured.pairs[input]
    names, omega = (input, output), responses.omega
    return draw_response(names, omega, pair, unit, note, measured.averages, curves)


def table(responses: FlightResponses) -> dict[str, Any]:
    """Return the columns of responses.csv, with a row for each pair and frequency."""
    parts: dict[str, list[Any]] = {}
    omega = responses.omega
    for name, output in responses.outputs.items():
        for input, pair in output.pairs.items():
            seen = seen_of(omega, pair, output.averages)
            with np.errstate(all="ignore"):
                each = {
                    "input": [input] * omega.size,
                    "output": [name] * omega.size,
                    "frequency_hz": omega / (2.0 * np.pi),
                    "gain": np.abs(pair.H),
                    "gain_db": 20.0 * np.log10(np.abs(pair.H)),
                    "phase_deg": branch_of(omega, pair.H, seen),
                    "gain_sd_db": _DB * pair.sd / np.abs(pair.H),
                    "phase_sd_deg": np.degrees(pair.sd / np.abs(pair.H)),
                    "coherence": pair.coherence,
                    "multiple_coherence": output.multiple,
                    "half95_in_sd": np.full(omega.size, pair.half95),
                }
            for n, v in each.items():
                parts.setdefault(n, []).append(v)
    names = {n: [name for part in parts.pop(n) for name in part] for n in ("input", "output")}
    return {**names, **{n: np.concatenate(v) for n, v in parts.items()}}


def transfer_status(fit: TransferFit | str) -> str:
    """Return converged, not-identifiable or not-converged, as in fit.json."""
    if isinstance(fit, str):
        return "not-identifiable"
    if not fit.converged:
        return "not-converged"
    delay = () if fit.delay is None else (fit.delay,)
    known = all(c.determined for c in (*fit.numerator, *fit.denominator, *delay))
    return "converged" if known else "not-identifiable"


def _content(request: TransferRequest, fit: TransferFit | str, window: float) -> dict[str, Any]:
    """Return an entry of transfer_functions.json."""
    status, found = transfer_status(fit), None if isinstance(fit, str) else fit
    numerator: list[dict[str, float]] = [{}] * (request.zeros + 1)
    denominator: list[dict[str, float]] = [{}] * request.poles
    delay: dict[str, float] | None = {} if request.delay else None
    if found is not None:
        numerator, denominator = (
            [_number(c) for c in of] for of in (found.numerator, found.denominator)
        )
        delay = None if found.delay is None else _number(found.delay)
    return {
        "input": request.input,
        "output": request.output,
        "numerator": numerator,
        "denominator": [{"value": 1.0}, *denominator],
        "delay_s": delay,
        "poles": _roots_of(found.poles, found.denominator) if found else None,
        "zeros": _roots_of(found.zeros, found.numerator) if found else None,
        "chi_squared_per_degree": found.chi_squared if found else None,
        "J": found.J if found else None,
        "status": status,
        "converged": status == "converged",
        "determined": bool(found and found.determined),
        "windows_taken_off": bool(found and decays_within(found, window)),
        "sentences": fit_sentences(fit, window),
    }


def _roots_of(roots: np.ndarray, of: Sequence[Coefficient]) -> list[list[float]] | None:
    """Return real and imaginary part of each root; None if a coefficient is not determined."""
    return [[r.real, r.imag] for r in roots] if all(c.determined for c in of) else None


def _number(c: Coefficient) -> dict[str, float]:
    if not c.determined:
        return {}
    return {"value": c.value, "sd": c.sd, "lower95": c.lower95, "upper95": c.upper95}


def fit_sentences(fit: TransferFit | str, window: float) -> list[str]:
    """Return the cautions about a transfer function."""
    if isinstance(fit, str):
        return [f"not fitted: {fit}"]
    if not fit.determined:
        return ["the response does not determine it: use fewer poles, or more excitation"]
    if not fit.converged:
        return ["the optimiser did not converge: these numbers are not a result"]
    remarks = []
    if fit.chi_squared > _TOO_LARGE:
        remarks.append(
            f"squared errors are {number(fit.chi_squared, 2)} times their expected value: the "
            f"order is too low, the vehicle is not linear, or a window of {window:.3g} s is too "
            "short"
        )
    if not decays_within(fit, window):
        last = max(fit.poles, key=lambda p: p.real)
        # A window resolves a period only if it contains two of them.
        slow = abs(last) * window < 4.0 * np.pi
        remarks.append(
            f"a pole of {number(last.real, 2)} 1/s does not decay within a window of {window:.3g} "
            "s; the windows cut off part of its response, so that intervals may be too narrow"
            + ("; it cannot be distinguished from an integrator or a slower pole" if slow else "")
            + ": for an angle fit the response of its rate, or a model by frequency-error"
        )
    known = all(c.determined for c in fit.denominator)
    if known and (growing := [p.real for p in fit.poles if p.real > 0.0]):
        remarks.append(
            f"it is unstable (a pole with the real part +{number(max(growing), 3)} rad/s); if the "
            "vehicle is stable, a late stick, feedback or a wrong order can cause this"
        )
    return remarks


FIT_HEAD = ("numerator", "denominator", "poles [rad/s]", "delay [ms]", "chi² per degree", "J")


def fit_row(fit: TransferFit | str) -> tuple[str, ...]:
    """Return the cells of `FIT_HEAD`."""
    if isinstance(fit, str):
        return ("not fitted", *("–" for _ in FIT_HEAD[1:]))
    delay = "–" if fit.delay is None else _measured(fit.delay, 1e3)
    return (
        _polynomial(fit.numerator, ""),
        _polynomial(fit.denominator, f"s{_power(len(fit.denominator))}"),
        _roots(fit),
        delay,
        number(fit.chi_squared, 3),
        number(fit.J, 3),
    )


def _polynomial(coefficients: tuple[Coefficient, ...], lead: str) -> str:
    terms = [lead] if lead else []
    for i, c in enumerate(coefficients):
        n = len(coefficients) - 1 - i
        terms.append(f"({_measured(c)})" + (f" s{_power(n)}" if n else ""))
    return " + ".join(terms)


def _roots(fit: TransferFit) -> str:
    """Return poles as text: frequency and damping of a pair, or a number."""
    if not all(c.determined for c in fit.denominator):
        return "not determined"
    words = []
    for pole in sorted(fit.poles, key=abs):
        if pole.imag > 0.0:
            damping = number(-pole.real / abs(pole), 3)
            words.append(f"ω {number(abs(pole), 4)}, ζ {damping}")
        elif pole.imag == 0.0:
            words.append(number(pole.real, 4))
    return "; ".join(words)


def _power(n: int) -> str:
    return "" if n == 1 else str(n).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _measured(c: Coefficient, factor: float = 1.0) -> str:
    if not c.determined:
        return "not determined"
    return with_sd(c.value * factor, c.sd * factor)


def useful_band(omega: np.ndarray, pair: Pair) -> tuple[str, str, str]:
    """Return as text the mean coherence, and the widest band with coherence above 0.6 and small
    error.
    """
    seen = np.isfinite(pair.coherence)
    if not seen.any():
        return "not determined", "–", "–"
    mean = f"{np.mean(pair.coherence[seen]):.2f}"
    # The window's leakage around a sine is coherent too.
    with np.errstate(invalid="ignore"):
        sure = pair.sd < _SURE * np.abs(pair.H)
    good = (np.where(seen, pair.coherence, 0.0) > COHERENT) & sure
    bands = np.ma.clump_masked(np.ma.array(omega, mask=good))
    if not bands:
        return mean, "–", "–"
    # The width is measured in octaves.
    widest = max((omega[band] for band in bands), key=lambda w: w[-1] / w[0])
    low, high = (number(float(w) / (2.0 * np.pi), 3) for w in (widest[0], widest[-1]))
    return mean, low, high
