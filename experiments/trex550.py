"""Roll of a flybarless T-Rex from a real log: servo, rate loop and delay, or a first-order lag.

    .venv/bin/python experiments/trex550.py LOG [FURTHER ...]

LOG is Pitchtest.csv of github.com/dronefreak/system-identification-helicopter (MIT): an Align T-Rex
550, 67 s near hover at 100 Hz, with columns t, lat, p and others. The models are fitted to the
lateral doublets (18 to 32 s). They then simulate the whole record, and each FURTHER log
(Hovertest.csv of the same vehicle). The agreement is shown for all samples, and for those where the
lateral stick moves. There its sd over 4 s (two periods of a doublet) is at least a share of its sd
over the fitted doublets.
"""

import argparse
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import scipy.ndimage

from heli_jax import (
    Flight,
    Free,
    Problem,
    Signal,
    fit,
    load_config,
    models,
    naming,
    read_flight,
    simulate,
)
from heli_jax import config as configuration
from heli_jax.dynamics.model import Model
from heli_jax.naming import Scalar

jax.config.update("jax_enable_x64", True)
WINDOW = (18.0, 32.0)
AROUND = 4.0
"""Width of the window about a sample for the stick's sd [s]: two periods of a doublet."""
SHARES = (0.2, 0.25, 0.3)
"""Least sd of a moving stick [fraction of that over the fitted doublets]."""
CONFIG = Path(__file__).parents[1] / "configs" / "trex550-roll.yaml"


class Lag(NamedTuple):
    K: Annotated[Scalar, "rad/s", "rate for a full stick"]
    tau: Annotated[Scalar, "s", "time constant"]


class Rate(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]


class Stick(NamedTuple):
    lat: Annotated[Scalar, "1", "lateral stick"]


def _lag(params: Any, x: Any, u: Any) -> Rate:
    return Rate(p=(params.K * u.lat - x.p) / params.tau)


def _rate(params: Any, x: Any, u: Any) -> Rate:
    return Rate(p=x.p)


def first_order() -> tuple[Model, Any, dict[str, Free]]:
    """Return p = K/(tau s + 1) lat; the delay may be negative, since the log's stick is late."""
    bare = Model("first-order", _lag, _rate, Lag, Rate, Stick, Rate, linear=True)
    model = models.with_delays(bare, inputs=["lat"])
    start = model.Params(K=1.0, tau=0.1, delay_lat=0.0)
    return model, start, {"K": Free(1.0), "tau": Free(0.1), "delay_lat": Free(-0.05)}


def flybarless(path: str, *, feedforward: bool) -> tuple[Model, Any, dict[str, Free]]:
    """Return the configuration's rotor, servo, rate loop, delay and optional feed-forward."""
    changes: dict[str, Any] = {f"flights.{i}.log": str(Path(path).resolve()) for i in range(3)}
    if feedforward:
        changes["onboard.rate_loop.feedforward"] = True
        changes["fit.free.Kff_lat"] = {"start": 0.1, "sign": "keep"}
    problem = configuration.problem(load_config(CONFIG, changes))
    return problem.model, problem.vehicle, dict(problem.free)


def vaf(measured: np.ndarray, simulated: np.ndarray) -> float:
    """Return the variance accounted for, without the bias."""
    return 1.0 - float(np.var(measured - simulated) / np.var(measured))


def read(path: str, **options: Any) -> Flight:
    return read_flight(
        path,
        time="t",
        inputs={"lat": Signal("lat", "1", "1")},
        outputs={"p": Signal("p", "rad/s", "rad/s")},
        **options,
    )


def _flown(model: Model, params: Any, log: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Return the roll rate, measured and simulated (N,) [rad/s]."""
    return np.asarray(log.outputs["p"]), np.asarray(simulate(model, params, log).outputs.p)


def _fitted(log: Flight) -> np.ndarray:
    """Return a mask of samples (N,) in the fitted window."""
    t = np.arange(log.outputs["p"].size) * log.dt
    return (t >= WINDOW[0]) & (t <= WINDOW[1])


def stick_sd(log: Flight) -> np.ndarray:
    """Return the sd of the lateral stick over `AROUND` seconds about each sample (N,)."""
    lat, n = np.asarray(log.inputs["lat"]), round(AROUND / log.dt)

    def mean(x: np.ndarray) -> np.ndarray:
        return scipy.ndimage.uniform_filter1d(x, n)

    return np.sqrt(np.maximum(mean(lat**2) - mean(lat) ** 2, 0.0))


def agreement(model: Model, params: Any, whole: Flight) -> dict[str, float]:
    """Return the VAF in the fitted window, of the whole record, and of the rest of the record."""
    measured, simulated = _flown(model, params, whole)
    fitted = _fitted(whole)
    return {
        "18-32 s": vaf(measured[fitted], simulated[fitted]),
        "whole": vaf(measured, simulated),
        "rest": vaf(measured[~fitted], simulated[~fitted]),
    }


def where_the_stick_moves(
    model: Model, params: Any, log: Flight, doublets: float, kept: np.ndarray
) -> dict[float, tuple[float, float]]:
    """Return duration [s] and VAF of the kept samples (N,) for each share of a moving stick.

    Args:
        model: simulated over the whole log.
        params: its parameters.
        log: log with the stick `lat` and the rate `p`.
        doublets: the stick's sd over the fitted doublets.
        kept: mask of samples that may count (N,).
    """
    measured, simulated = _flown(model, params, log)
    found = {}
    for share in SHARES:
        moves = kept & (stick_sd(log) >= share * doublets)
        if moves.any():
            agreed = vaf(measured[moves], simulated[moves])
            found[share] = float(np.sum(moves) * log.dt), agreed
    return found


def main(path: str, further: list[str]) -> None:
    window, whole = read(path, window=WINDOW), read(path)
    doublets = float(np.std(window.inputs["lat"]))
    print("| model | VAF 18-32 s | whole record | rest | estimates |")
    print("|---|---|---|---|---|")
    candidates = (
        first_order(),
        flybarless(path, feedforward=False),
        flybarless(path, feedforward=True),
    )
    moving = []
    for model, params, free in candidates:
        estimate = fit(Problem(model, params, [window], free))
        values = {n: e.value for n, e in estimate.estimates.items()}
        fitted = naming.replace(params, **values)
        seen = agreement(model, fitted, whole)
        numbers = ", ".join(
            f"{n} {e.value:.3g}" + ("" if e.sd is None else f" +- {e.sd:.1g}")
            for n, e in estimate.estimates.items()
        )
        name = model.name + (", feed-forward" if "Kff_lat" in free else "")
        shares = " | ".join(f"{v:.4f}" for v in seen.values())
        print(f"| {name} | {shares} | {estimate.status}: {numbers} |")
        rest = where_the_stick_moves(model, fitted, whole, doublets, ~_fitted(whole))
        moving += [(name, Path(path).stem + ", rest", rest)]
        for other in further:
            log = read(other)
            kept = np.ones(log.outputs["p"].size, bool)
            seen_there = where_the_stick_moves(model, fitted, log, doublets, kept)
            moving += [
                (name, Path(other).stem, {0.0: _as_a_whole(model, fitted, log), **seen_there})
            ]
    print()
    print("| model | log | stick's sd at least, of the doublets' | s | VAF |")
    print("|---|---|---|---|---|")
    for name, log_name, found in moving:
        for share, (seconds, agreed) in found.items():
            print(f"| {name} | {log_name} | {share:g} | {seconds:.1f} | {agreed:.3f} |")


def _as_a_whole(model: Model, params: Any, log: Flight) -> tuple[float, float]:
    measured, simulated = _flown(model, params, log)
    return measured.size * log.dt, vaf(measured, simulated)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="A minute on two cores, of the two logs.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", metavar="LOG")
    parser.add_argument("further", metavar="FURTHER", nargs="*", help="flown, and not fitted to")
    options = parser.parse_args()
    main(options.log, options.further)
