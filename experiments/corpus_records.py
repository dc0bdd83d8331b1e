"""Records of corpus.py for configurations: sound ones, and ones with one fault each.

Linear models are written to YAML; logs are simulated by SciPy and written to CSV. Each fault is one
that a diagnostic of the package should find.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal
import yaml
from closed_loop import ACTS, DT, STEP, TRUTH, record

from heli_jax.simulation.inputs import random_steps

Columns = dict[str, np.ndarray]
"""Columns of a log by name, `t` first."""
N = 1500
"""Samples of closed_loop.record."""


def linear(A: dict, B: dict, outputs: Mapping[str, str], **sections: Any) -> dict[str, Any]:
    """Return a model in the form of a file; states take units from `states`."""
    return {"name": "rig", "outputs": dict(outputs), "A": A, "B": B, **sections}


def _parameters(**of: tuple[float, str]) -> dict[str, Any]:
    return {n: {"value": value, "unit": unit} for n, (value, unit) in of.items()}


ROLL = linear(
    {"p": {"p": "Lp"}, "phi": {"p": 1}},
    {"p": {"da": "Lda"}},
    {"p": "rad/s", "phi": "rad"},
    states={"p": "rad/s", "phi": "rad"},
    inputs={"da": "rad"},
    parameters=_parameters(Lp=(-2.0, "1/s"), Lda=(10.0, "1/s^2")),
    axes={"roll": {"rate": "p", "angle": "phi", "stick": "da"}},
)
LATE = ROLL | {
    "parameters": {**ROLL["parameters"], **_parameters(tau=(0.03, "s"))},
    "delays": {"da": "tau"},
}
TWO_AXES = linear(
    {"p": {"p": "Lp"}, "q": {"q": "Mq"}, "phi": {"p": 1}, "theta": {"q": 1}},
    {"p": {"da": "Lda"}, "q": {"de": "Mde"}},
    {"p": "rad/s", "q": "rad/s", "phi": "rad", "theta": "rad"},
    states={"p": "rad/s", "q": "rad/s", "phi": "rad", "theta": "rad"},
    inputs={"da": "rad", "de": "rad"},
    parameters=_parameters(
        Lp=(-2.0, "1/s"), Lda=(10.0, "1/s^2"), Mq=(-2.0, "1/s"), Mde=(10.0, "1/s^2")
    ),
    axes={
        "roll": {"rate": "p", "angle": "phi", "stick": "da"},
        "pitch": {"rate": "q", "angle": "theta", "stick": "de"},
    },
)
SPRING = linear(
    {"x": {"v": 1}, "v": {"x": "-k", "v": "-d"}},
    {"v": {"f": "b"}},
    {"x": "m"},
    states={"x": "m", "v": "m/s"},
    inputs={"f": "1"},
    parameters={
        "k": {"value": 1.0, "unit": "1/s^2", "positive": True},
        "d": {"value": 0.1, "unit": "1/s", "positive": True},
        "b": {"value": 1.0, "unit": "m/s^2"},
    },
)
SERVO = linear(
    {"p": {"p": "Lp", "s": "L"}, "s": {"s": "-1/ts"}},
    {"s": {"u": "1/ts"}},
    {"p": "rad/s"},
    states={"p": "rad/s", "s": "1"},
    inputs={"u": "1"},
    parameters=_parameters(Lp=(-12.0, "1/s"), L=(80.0, "rad/s^2"), ts=(0.1, "s")),
)
LAGS = linear(
    {"a": {"a": "-1/T1"}, "b": {"a": "1/T2", "b": "-1/T2"}},
    {"a": {"u": "K/T1"}},
    {"b": "1"},
    states={"a": "1", "b": "1"},
    inputs={"u": "1"},
    parameters=_parameters(T1=(0.1, "s"), T2=(0.4, "s"), K=(2.0, "1")),
)
SUM = linear(
    {"p": {"p": "La + Lb"}},
    {"p": {"u": "K"}},
    {"p": "rad/s"},
    states={"p": "rad/s"},
    inputs={"u": "1"},
    parameters=_parameters(La=(-1.0, "1/s"), Lb=(-1.0, "1/s"), K=(10.0, "rad/s^2")),
)
HEAVE = linear(
    {"w": {"w": "Zw"}},
    {"w": {"col": "Zcol"}},
    {"w": "m/s"},
    states={"w": "m/s"},
    inputs={"col": "1"},
    parameters=_parameters(Zw=(-1.5, "1/s"), Zcol=(-5.0, "m/s^2")),
    axes={"heave": {"rate": "w", "stick": "col"}},
)
BY_SPEED = linear(
    {"w": {"w": "Zw"}},
    {"w": {"om": "Zo"}},
    {"w": "m/s", "az": "m/s^2"},
    states={"w": "m/s"},
    inputs={"om": "rad/s"},
    C={"az": {"w": "Zw"}},
    D={"az": {"om": "Zo"}},
    parameters=_parameters(Zw=(-0.4, "1/s"), Zo=(-0.1, "m/s/rad")),
)
INFLOW = linear(
    {"w": {"w": "Zw", "nu": 6}, "nu": {"nu": "-1/tn"}},
    {"w": {"col": "Zc"}, "nu": {"col": "Kn/tn"}},
    {"az": "m/s^2"},
    states={"w": "m/s", "nu": "m/s"},
    inputs={"col": "1"},
    C={"az": {"w": "Zw", "nu": 6}},
    D={"az": {"col": "Zc"}},
    parameters=_parameters(Zw=(-9.1, "1/s"), Kn=(-3.9, "m/s"), tn=(1.82, "s"), Zc=(-28.0, "m/s^2")),
    axes={"heave": {"rate": "w", "stick": "col"}},
)
FILTER = {"fit": {"method": "filter-error"}, "disturbance": {"on": ["roll"]}}


def simulated(
    A: Sequence, B: Sequence, u: np.ndarray, dt: float = DT, push: np.ndarray | None = None
) -> np.ndarray:
    """Return states (N, n) from zero, for a held input (N,) and a held push (N, n)."""
    n = len(A)
    M = np.zeros((2 * n + 1, 2 * n + 1))
    M[:n, :n], M[:n, n], M[:n, n + 1 :] = A, B, np.eye(n)
    E = np.asarray(scipy.linalg.expm(M * dt))
    x, out = np.zeros(n), []
    for k, now in enumerate(u):
        out.append(x)
        more = 0.0 if push is None else E[:n, n + 1 :] @ push[k]
        x = E[:n, :n] @ x + E[:n, n] * now + more
    return np.array(out)


def roll(seed: int = 1, gain: float = 0.0, gust: float = 0.0, acts: int = 0) -> Columns:
    """Return the record of closed_loop.record, with the pilot's excitation."""
    flight = record(gain, gust, seed, acts)
    excitation = STEP * random_steps(N, DT, np.random.default_rng(seed), (0.2, 1.5))
    t = np.arange(N) * DT
    return {"t": t, **flight.inputs, **flight.outputs, "excitation": excitation}


def noisy(y: np.ndarray, part: float, rng: np.random.Generator) -> np.ndarray:
    """Add white noise of a fraction of the signal's sd."""
    return y + part * np.std(y) * rng.standard_normal(y.shape)


def steps(n: int, seed: int, dt: float = DT) -> np.ndarray:
    """Return random steps of 0.2 to 1.5 s."""
    return random_steps(n, dt, np.random.default_rng(seed), (0.2, 1.5))


def two_axes(turned: float) -> Columns:
    """Return roll and pitch, with the gyro turned about the vertical [deg]."""
    rng, n = np.random.default_rng(5), 2000
    # Each step is reversed after half a second, so that the vehicle stays about level.
    random = {"da": 0.05 * steps(n, 6), "de": 0.05 * steps(n, 7)}
    sticks = {name: u - np.r_[np.zeros(25), u[:-25]] for name, u in random.items()}
    p, phi = simulated([[-4.0, 0.0], [1.0, 0.0]], [25.0, 0.0], sticks["da"]).T
    q, theta = simulated([[-3.0, 0.0], [1.0, 0.0]], [20.0, 0.0], sticks["de"]).T
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    seen = {"p": c * p + s * q, "q": c * q - s * p, "phi": phi, "theta": theta}
    noisy_ones = {name: noisy(y, 0.03, rng) for name, y in seen.items()}
    return {"t": np.arange(n) * DT, **sticks, **noisy_ones}


def spring() -> Columns:
    """Return a mass on a spring five times as fast as the model's values."""
    rng = np.random.default_rng(0)
    f = rng.standard_normal(1000)
    x = simulated([[0.0, 1.0], [-25.0, -0.5]], [0.0, 20.0], f, 0.1)[:, 0]
    return {"t": 0.1 * np.arange(1000), "f": f, "x": x + 0.05 * rng.standard_normal(1000)}


def servo() -> Columns:
    """Return a lag of 0.05 s before a damping of 6 1/s."""
    u = steps(1000, 11)
    p = simulated([[-6.0, 40.0], [0.0, -20.0]], [0.0, 20.0], u)[:, 0]
    return {"t": DT * np.arange(1000), "u": u, "p": noisy(p, 0.05, np.random.default_rng(2))}


def lags() -> Columns:
    """Return two lags in series, of 0.06 and 0.3 s."""
    u = steps(1000, 12)
    b = simulated([[-1 / 0.06, 0.0], [1 / 0.3, -1 / 0.3]], [3.0 / 0.06, 0.0], u)[:, 1]
    return {"t": DT * np.arange(1000), "u": u, "b": noisy(b, 0.05, np.random.default_rng(3))}


def damping() -> Columns:
    """Return a rate whose damping is the sum of two."""
    u = steps(1000, 13)
    p = simulated([[-3.5]], [20.0], u)[:, 0]
    return {"t": DT * np.arange(1000), "u": u, "p": noisy(p, 0.05, np.random.default_rng(4))}


def heave(gust: float, amplitude: float) -> Columns:
    """Return a minute of collective pulses in gusts of 1 s correlation time; Zw -0.6, Zcol -14."""
    rng, n = np.random.default_rng(0), 3000
    col = amplitude * np.repeat(rng.choice([-1.0, 0.0, 1.0], n // 50), 50)
    keep = np.exp(-DT)
    drive = gust * np.sqrt(1 - keep**2) * rng.standard_normal(n)
    wind = np.asarray(scipy.signal.lfilter([1.0], [1.0, -keep], drive))
    w = simulated([[-0.6]], [-14.0], col, push=0.6 * wind[:, None])[:, 0]
    return {"t": DT * np.arange(n), "col": col, "w": w + 0.1 * rng.standard_normal(n)}


def by_rotor_speed(felt: bool) -> Columns:
    """Return heave from rotor speed, whose noise acts on the vehicle (command) or not (sensor)."""
    rng, n = np.random.default_rng(4), 3000
    slow = 8.0 * np.asarray(scipy.signal.lfilter([0.02], [1.0, -0.98], rng.standard_normal(n)))
    noise, Zw, Zo = 0.2 * rng.standard_normal(n), -0.7, -0.22
    om: np.ndarray = slow + (noise if felt else 0.0)
    system: Any = tuple(np.array([[v]]) for v in (Zw, Zo, 1.0, 0.0))
    sampled: Any = scipy.signal.cont2discrete(system, DT, method="foh")
    A, B, C, D, _ = sampled
    x = np.asarray(scipy.signal.dlsim((A, B, C, D, DT), om)[1])[:, 0]
    w, az = x + 0.01 * rng.standard_normal(n), Zw * x + Zo * om + 0.05 * rng.standard_normal(n)
    return {"t": DT * np.arange(n), "om": om if felt else om + noise, "w": w, "az": az}


def inflow() -> Columns:
    """Return heave with inflow in gusts; the model starts with its two modes exchanged."""
    rng, n = np.random.default_rng(5), 2000
    col = 0.1 * np.repeat(rng.choice([-1.0, 0.0, 1.0], n // 50), 50)
    keep = np.exp(-DT / 0.4)
    drive = 0.35 * np.sqrt(1 - keep**2) * rng.standard_normal(n)
    gust = np.asarray(scipy.signal.lfilter([1.0], [1.0, -keep], drive))
    A, B = [[-0.55, 6.0], [0.0, -1 / 0.11]], [-28.0, 1.26 / 0.11]
    x = simulated(A, B, col, push=np.stack([gust, np.zeros(n)], axis=1))
    az = x @ [-0.55, 6.0] - 28.0 * col + gust + 0.1 * rng.standard_normal(n)
    return {"t": DT * np.arange(n), "col": col, "az": az}


def computed() -> Columns:
    """Return a chirp that is computed and held at each sample; in a log the stick seems to move."""
    t = np.arange(1000) * DT
    da = 0.1 * np.sin(2.0 * np.pi * (0.2 + 0.1 * t) * t)
    p, phi = simulated([[-4.0, 0.0], [1.0, 0.0]], [25.0, 0.0], da).T
    rng = np.random.default_rng(1)
    sd = 0.003 * rng.standard_normal((2, t.size))
    return {"t": t, "da": da, "p": p + sd[0], "phi": phi + 0.1 * sd[1]}


# Faults: functions that change the columns.


def late(x: Columns) -> Columns:
    """Log the stick 0.1 s late."""
    return x | {"da": np.r_[np.full(5, x["da"][0]), x["da"][:-5]]}


def clipped(x: Columns) -> Columns:
    """Clip p at half of its largest value before noise is added."""
    rng, top = np.random.default_rng(8), 0.5 * np.max(np.abs(x["p"]))
    return x | {"p": np.clip(x["p"], -top, top) + 0.01 * rng.standard_normal(N)}


def held(x: Columns) -> Columns:
    """Repeat p for 5 to 15 samples, 30 times."""
    rng, p = np.random.default_rng(4), x["p"].copy()
    for first in np.linspace(50, N - 50, 30).astype(int):
        p[first : first + rng.integers(5, 16)] = p[first]
    return x | {"p": p}


def strayed(x: Columns) -> Columns:
    """Put p far off at five samples."""
    p = x["p"].copy()
    p[[200, 477, 801, 1100, 1311]] = [31.0, -28.0, 35.5, 22.0, -30.0]
    return x | {"p": p}


def dropped(x: Columns) -> Columns:
    """Set the stick to -1 for single samples, 40 times."""
    da = np.round(x["da"], 5)
    da[np.random.default_rng(1).choice(np.arange(5, N - 5, 7), 40, replace=False)] = -1.0
    return x | {"da": da}


def drifting(x: Columns) -> Columns:
    """Integrate phi from the gyro, as an autopilot does."""
    return x | {"phi": np.cumsum(x["p"]) * DT}


def sparse(x: Columns) -> Columns:
    """Keep phi at every fifth sample only."""
    return x | {"phi": np.where(np.arange(N) % 5 == 0, x["phi"], np.nan)}


def missing(x: Columns) -> Columns:
    """Remove a tenth of p."""
    gone = np.random.default_rng(2).uniform(size=N) < 0.1
    return x | {"p": np.where(gone, np.nan, x["p"])}


def times(**factors: float) -> Callable[[Columns], Columns]:
    """Return a function that scales columns, for other units or signs."""
    return lambda x: x | {n: factor * x[n] for n, factor in factors.items()}


class Rig(NamedTuple):
    """A record and its configuration."""

    made: Callable[[], Columns | list[Columns]]
    model: dict[str, Any] = ROLL
    truth: Mapping[str, float] = {}
    """True values of the parameters."""
    asks: Mapping[str, Any] = {}
    """Sections of the configuration; default of `fit.free`: all parameters of the model."""
    signals: Mapping[str, Any] = {}
    flights: Sequence[Mapping[str, Any]] = ({},)
    """Keys of each flight besides its log."""
    ought: tuple[str, ...] | None = None
    """Parts of codes, of which one must appear; None: the record is sound."""
    exact: bool = True
    """True if exit code 0 with estimates within 3 sd of the truth is also right."""
    do: Sequence[str] = ("fit",)


def written(rig: Rig, folder: Path) -> Path:
    """Write model, logs and configuration; return the path of the configuration."""
    made = rig.made()
    logs = made if isinstance(made, list) else [made]
    (folder / "m.yaml").write_text(yaml.safe_dump(rig.model))
    flights = []
    for i, log in enumerate(logs):
        body = np.stack(list(log.values()), axis=1)
        cells = [",".join("" if np.isnan(v) else f"{v:.9g}" for v in row) for row in body]
        (folder / f"log{i}.csv").write_text("\n".join([",".join(log), *cells]) + "\n")
        units = {**rig.model["inputs"], **rig.model["outputs"]}
        named = {
            kind: {n: {"signal": n, "unit": units[n]} for n in rig.model[kind] if n in log}
            for kind in ("inputs", "outputs")
        }
        keys = rig.flights[min(i, len(rig.flights) - 1)]
        signals = {"time": {"signal": "t"}, **named, **rig.signals}
        flights.append({"log": f"log{i}.csv", "signals": signals, **keys})
    asks = {k: dict(v) if isinstance(v, Mapping) else v for k, v in rig.asks.items()}
    free = {n: {} for n in rig.model["parameters"]}
    fit = {"free": free, **asks.pop("fit", {})}
    content = {"model": {"linear": "m.yaml"}, "flights": flights, "fit": fit, "rls": None, **asks}
    path = folder / "fit.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def stated_held(name: str, unit: str) -> dict[str, Any]:
    """Return signals of a log with one input that is stated to be held between samples."""
    return {"inputs": {name: {"signal": name, "unit": unit, "hold": "zero-order"}}}


DELAYED = TRUTH | {"tau": ACTS * DT}
FREQUENCY = {"fit": {"method": "frequency-error"}}
RESPONSE = {"fit": {"method": "frequency-response"}}
BY_EXCITATION = {"instruments": {"da": {"signal": "excitation"}}}
OTHER = {"Lp": {"start": -2.0}, "Lda": {"start": 10.0, "sign": "keep"}}


def _fit(**keys: Any) -> dict[str, Any]:
    return {"fit": keys}


RIGS: dict[str, Rig] = {
    # Sound records.
    "plain": Rig(roll, truth=TRUTH, do=("fit", "check", "frf")),
    "filter error": Rig(lambda: roll(2, gust=2.0), truth=TRUTH, asks=FILTER, do=("fit", "check")),
    "loop filter error": Rig(lambda: roll(3, 0.3, 2.0), truth=TRUTH, asks=FILTER),
    "loop frequency error by instrument": Rig(
        lambda: roll(4, 0.3, 0.5), truth=TRUTH, asks=FREQUENCY, signals=BY_EXCITATION
    ),
    "loop frequency response by instrument": Rig(
        lambda: roll(5, 0.3, 0.5),
        truth=TRUTH,
        asks=RESPONSE,
        signals=BY_EXCITATION,
        do=("fit", "frf"),
    ),
    "frequency error": Rig(roll, truth=TRUTH, asks=FREQUENCY),
    "frequency response": Rig(roll, truth=TRUTH, asks=RESPONSE),
    "two flights": Rig(lambda: [roll(1), roll(6)], truth=TRUTH),
    "held out": Rig(lambda: [roll(1), roll(6)], truth=TRUTH, flights=({}, {"hold_out": True})),
    "missing samples": Rig(lambda: missing(roll(1)), truth=TRUTH),
    "slow angle": Rig(lambda: sparse(roll(1)), truth=TRUTH),
    "delay": Rig(lambda: roll(1, acts=ACTS), LATE, DELAYED),
    "delay in a loop": Rig(lambda: roll(3, 0.3, 2.0, ACTS), LATE, DELAYED, FILTER),
    "late stick, shift free": Rig(
        lambda: late(roll(1)), truth=TRUTH, asks=_fit(nuisance={"time_shift": True})
    ),
    "windows": Rig(roll, truth=TRUTH, asks=_fit(shooting={"window": 3.0})),
    "intervals by profile, bootstrap and NUTS": Rig(
        roll,
        truth=TRUTH,
        asks=_fit(intervals={"profile": ["Lp"], "bootstrap": 24, "nuts": 30}),
        flights=({"window": [0, 8]},),
    ),
    "start by equation error": Rig(roll, truth=TRUTH, asks=_fit(start="equation-error")),
    "also frequency error": Rig(roll, truth=TRUTH, asks=_fit(also=["frequency-error"])),
    "other models": Rig(
        lambda: roll(2, gust=2.0),
        truth=TRUTH,
        asks=FILTER | _fit(method="filter-error", compare=True),
    ),
    "recursive least squares": Rig(roll, truth=TRUTH, asks={"rls": {"order": 2}}),
    "two axes": Rig(lambda: two_axes(0.0), TWO_AXES),
    "rotor speed that was commanded": Rig(
        lambda: by_rotor_speed(True), BY_SPEED, {"Zw": -0.7, "Zo": -0.22}
    ),
    "heave in calm air": Rig(lambda: heave(0.0, 0.15), HEAVE, {"Zw": -0.6, "Zcol": -14.0}),
    # Sound records that may mislead the search or the reader.
    "computed command": Rig(computed, truth=TRUTH, ought=("likelier-hold",)),
    "computed command, stated": Rig(computed, truth=TRUTH, signals=stated_held("da", "rad")),
    "spring far from its start": Rig(
        spring,
        SPRING,
        {"k": 25.0, "d": 0.5, "b": 20.0},
        signals=stated_held("f", "1"),
    ),
    "heave by frequency error": Rig(
        lambda: heave(1.0, 0.04), HEAVE, {"Zw": -0.6, "Zcol": -14.0}, FREQUENCY
    ),
    "inflow begun on the other side": Rig(
        inflow,
        INFLOW,
        {"Zw": -0.55, "Kn": 1.26, "tn": 0.11, "Zc": -28.0},
        {"fit": {"method": "filter-error"}, "disturbance": {"on": ["heave"]}},
    ),
    # Faults.
    "late stick": Rig(lambda: late(roll(1)), truth=TRUTH, ought=("late",)),
    "late stick in a loop": Rig(
        lambda: late(roll(3, 0.3, 2.0)), truth=TRUTH, asks=FILTER, ought=("late", "adequacy")
    ),
    "p of the other sign": Rig(lambda: times(p=-1.0)(roll(1)), truth=TRUTH, ought=("sign",)),
    "stick of the other sign, sign kept": Rig(
        lambda: times(da=-1.0)(roll(2, gust=2.0)),
        truth=TRUTH,
        asks=FILTER | _fit(method="filter-error", free=OTHER),
        ought=("adequacy", "sign"),
    ),
    "p in degrees": Rig(lambda: times(p=57.3)(roll(1)), truth=TRUTH, ought=("unit",)),
    "p clipped": Rig(lambda: clipped(roll(1)), truth=TRUTH, ought=("amplitude",)),
    "p repeated": Rig(lambda: held(roll(1)), truth=TRUTH, ought=("stuck",)),
    "p astray": Rig(lambda: strayed(roll(1)), truth=TRUTH, ought=("stray",)),
    "stick that drops out": Rig(
        lambda: dropped(roll(1)), truth=TRUTH, ought=("amplitude", "adequacy")
    ),
    "a dead stick in one of three": Rig(
        lambda: [roll(1), roll(6), times(da=0.0)(roll(7))], truth=TRUTH, ought=("adequacy",)
    ),
    "another machine in one of three": Rig(
        lambda: [roll(1), roll(6), roll(7) | {"p": roll(8)["p"], "phi": roll(8)["phi"]}],
        truth=TRUTH,
        ought=("flights-differ",),
    ),
    "a turned gyro": Rig(lambda: two_axes(10.0), TWO_AXES, ought=("residual-follows",)),
    "angle of a gyro in filter error": Rig(
        lambda: drifting(roll(2, gust=2.0)), truth=TRUTH, asks=FILTER, ought=("white",)
    ),
    "rotor speed that was measured": Rig(
        lambda: by_rotor_speed(False), BY_SPEED, {"Zw": -0.7, "Zo": -0.22}, ought=("noise",)
    ),
    "gusts by output error": Rig(
        lambda: roll(2, gust=2.0), truth=TRUTH, ought=("second method", "trusted", "adequacy")
    ),
    "loop by output error": Rig(
        lambda: roll(3, 0.6, 2.0), truth=TRUTH, ought=("follow", "trusted", "adequacy")
    ),
    "loop by frequency error": Rig(
        lambda: roll(3, 0.6, 2.0), truth=TRUTH, asks=FREQUENCY, ought=("follow", "trusted")
    ),
    "two lags": Rig(lags, LAGS, ought=("exit exchangeable",), exact=False, do=("fit", "check")),
    "servo before damping": Rig(
        servo, SERVO, ought=("exit other solutions",), exact=False, do=("fit", "check")
    ),
    "sum of two dampings": Rig(damping, SUM, ought=("exit not-identifiable",), exact=False),
}

if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
