"""A flybarless helicopter's roll from a real log: does a model with servo, rate loop and delay
follow it better than a first-order lag, and does it predict what it was not fitted to?

    .venv/bin/python experiments/trex550.py LOG

LOG is Pitchtest.csv of github.com/dronefreak/system-identification-helicopter (MIT): an Align
T-Rex 550, 67 s near hover at 100 Hz, with columns t, lat, p and others. Both models are fitted to
the lateral doublets (18 to 32 s) and then fly the whole record.
"""

import argparse
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np

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
    """p = K/(tau s + 1) lat, with a delay that may be negative: the log has the stick late."""
    bare = Model("first-order", _lag, _rate, Lag, Rate, Stick, Rate, linear=True)
    model = models.with_delays(bare, inputs=["lat"])
    start = model.Params(K=1.0, tau=0.1, delay_lat=0.0)
    return model, start, {"K": Free(1.0), "tau": Free(0.1), "delay_lat": Free(-0.05)}


def flybarless(path: str, *, feedforward: bool) -> tuple[Model, Any, dict[str, Free]]:
    """Rotor, servo, rate loop, delay: the configuration; with a feed-forward where asked."""
    changes: dict[str, Any] = {f"flights.{i}.log": str(Path(path).resolve()) for i in range(3)}
    if feedforward:
        changes["onboard.rate_loop.feedforward"] = True
        changes["fit.free.Kff_lat"] = {"start": 0.1, "sign": "keep"}
    problem = configuration.problem(load_config(CONFIG, changes))
    return problem.model, problem.vehicle, dict(problem.free)


def vaf(measured: np.ndarray, simulated: np.ndarray) -> float:
    """Variance accounted for, without the bias."""
    return 1.0 - float(np.var(measured - simulated) / np.var(measured))


def read(path: str, **options: Any) -> Flight:
    return read_flight(
        path,
        time="t",
        inputs={"lat": Signal("lat", "1", "1")},
        outputs={"p": Signal("p", "rad/s", "rad/s")},
        **options,
    )


def agreement(model: Model, params: Any, whole: Flight) -> dict[str, float]:
    """VAF in the fitted window, of the whole record, and of the record without the window."""
    flown = simulate(model, params, whole).outputs.p
    simulated, measured = np.asarray(flown), np.asarray(whole.outputs["p"])
    t = np.arange(measured.size) * whole.dt
    fitted = (t >= WINDOW[0]) & (t <= WINDOW[1])
    return {
        "18-32 s": vaf(measured[fitted], simulated[fitted]),
        "whole": vaf(measured, simulated),
        "rest": vaf(measured[~fitted], simulated[~fitted]),
    }


def main(path: str) -> None:
    window, whole = read(path, window=WINDOW), read(path)
    print("| model | VAF 18-32 s | whole record | rest | estimates |")
    print("|---|---|---|---|---|")
    candidates = (
        first_order(),
        flybarless(path, feedforward=False),
        flybarless(path, feedforward=True),
    )
    for model, params, free in candidates:
        estimate = fit(Problem(model, params, [window], free))
        values = {n: e.value for n, e in estimate.estimates.items()}
        seen = agreement(model, naming.replace(params, **values), whole)
        numbers = ", ".join(
            f"{n} {e.value:.3g}" + ("" if e.sd is None else f" +- {e.sd:.1g}")
            for n, e in estimate.estimates.items()
        )
        name = model.name + (", feed-forward" if "Kff_lat" in free else "")
        shares = " | ".join(f"{v:.4f}" for v in seen.values())
        print(f"| {name} | {shares} | {estimate.status}: {numbers} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("log", metavar="LOG")
    main(parser.parse_args().log)
