"""A hundred identification problems with known answers, to find silent successes and false alarms.

    .venv/bin/python experiments/zoo.py [--quick] [--only WORDS]

Half of them are sound: a fit must converge, give every parameter an interval with the truth, and
find the model adequate. The others are not: exchangeable terms, a gain times an effectiveness, a
constant input, a short record, two inputs that move together, an unrelated record. There the fit
must not end in a silent success. Records come from SciPy and explicit matrices, not from our
simulation. The exit code is 1 if one fails.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal

from heli_jax import Fit, Flight, Free, Model, Nuisance, Prior, Problem, fit, load_vehicle, models
from heli_jax.dynamics.roll import roll_transfer_function
from heli_jax.naming import Scalar
from heli_jax.simulation.inputs import random_steps

DT, N = 0.02, 600
NO_OFFSET = Nuisance(input_offset=False)


class Params(NamedTuple):
    """Parameters of an aircraft in roll; each term appears twice, for products and sums."""

    Lp: Annotated[Scalar, "1/s", "roll damping"] = 0.0
    Lq: Annotated[Scalar, "1/s", "more of the same"] = 0.0
    Ld: Annotated[Scalar, "1/s^2", "effectiveness of the aileron"] = 0.0
    Le: Annotated[Scalar, "1/s^2", "effectiveness of a second surface"] = 0.0
    k: Annotated[Scalar, "1", "gain of the linkage"] = 1.0
    L0: Annotated[Scalar, "rad/s^2", "constant acceleration"] = 0.0


class State(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]
    phi: Annotated[Scalar, "rad", "roll angle"]


class Inputs(NamedTuple):
    d: Annotated[Scalar, "1", "aileron"]
    e: Annotated[Scalar, "1", "second surface"]


class Outputs(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate"]
    phi: Annotated[Scalar, "rad", "roll angle"]


def _rates(p: Params, s: State, u: Inputs) -> State:
    return State(
        p=(p.Lp + p.Lq) * s.p + p.k * p.Ld * u.d + p.Le * u.e + p.L0 + 0.0 * s.phi, phi=s.p
    )


ROLL = Model(
    "aircraft-roll",
    _rates,
    lambda p, s, u: Outputs(p=s.p, phi=s.phi),
    Params,
    State,
    Inputs,
    Outputs,
)


class PitchParams(NamedTuple):
    """Parameters of an aircraft's short period at a speed of V."""

    Zw: Annotated[Scalar, "1/s", "heave damping"]
    Mw: Annotated[Scalar, "rad/s/m", "static stability"]
    Mq: Annotated[Scalar, "1/s", "pitch damping"]
    Md: Annotated[Scalar, "1/s^2", "effectiveness of the elevator"]
    V: Annotated[Scalar, "m/s", "speed"]


class PitchState(NamedTuple):
    w: Annotated[Scalar, "m/s", "heave"]
    q: Annotated[Scalar, "rad/s", "pitch rate"]


class PitchInputs(NamedTuple):
    d: Annotated[Scalar, "1", "elevator"]


class PitchOutputs(NamedTuple):
    w: Annotated[Scalar, "m/s", "heave"]
    q: Annotated[Scalar, "rad/s", "pitch rate"]


PITCH = Model(
    "aircraft-pitch",
    lambda p, s, u: PitchState(w=p.Zw * s.w + p.V * s.q, q=p.Mw * s.w + p.Mq * s.q + p.Md * u.d),
    lambda p, s, u: PitchOutputs(w=s.w, q=s.q),
    PitchParams,
    PitchState,
    PitchInputs,
    PitchOutputs,
    linear=True,
)


@dataclass(frozen=True)
class Puzzle:
    """A problem and its answer."""

    name: str
    problem: Problem
    truth: dict[str, float]
    """True values of free parameters that the record determines."""
    not_identifiable: tuple[str, ...] = ()
    """Free parameters that it does not determine."""
    hardly: dict[str, float] = field(default_factory=dict)
    """Parameters with little information: not determined, or truth and zero in the interval."""
    adequate: bool = True


def stepped(A: Any, B: Any, u: np.ndarray, x0: Any) -> np.ndarray:
    """Return states (N, n) for held inputs (N, m), by SciPy."""
    A, B = np.atleast_2d(np.asarray(A, float)), np.asarray(B, float)
    system: Any = (A, B, np.eye(A.shape[0]), np.zeros(B.shape))
    held: Any = scipy.signal.cont2discrete(system, DT)
    Ad, Bd = held[:2]
    x, out = np.asarray(x0, float), []
    for now in u:
        out.append(x)
        x = Ad @ x + Bd @ now
    return np.array(out)


class Rolled(NamedTuple):
    """A record of the aircraft in roll, and its source."""

    params: Params
    d: np.ndarray
    e: np.ndarray
    p: np.ndarray
    phi: np.ndarray
    rng: np.random.Generator

    def flight(self, *outputs: str, noise: float = 0.01, **more: Any) -> Flight:
        measured = {n: getattr(self, n) for n in outputs}
        noisy = {
            n: y + noise * np.std(y) * self.rng.standard_normal(N) for n, y in measured.items()
        }
        return Flight(dt=DT, inputs={"d": self.d, "e": self.e}, outputs=noisy, **more)


def rolled(
    seed: int, e: Callable[[np.ndarray, Any], np.ndarray] | None = None, **values: float
) -> Rolled:
    rng = np.random.default_rng(seed)
    chosen = {"Lp": -rng.uniform(2, 8), "Ld": rng.uniform(20, 60) * rng.choice([-1, 1])} | values
    d = random_steps(N, DT, rng, (0.2, 1.0))
    second = np.zeros(N) if e is None else e(d, rng)
    full = {**Params(0.0)._asdict(), **chosen}
    A = [[full["Lp"] + full["Lq"], 0.0], [1.0, 0.0]]
    B = [[full["k"] * full["Ld"], full["Le"], full["L0"]], [0.0, 0.0, 0.0]]
    x = stepped(A, B, np.stack([d, second, np.ones(N)], axis=1), [0.3 * rng.standard_normal(), 0.0])
    params = Params(**{n: jnp.asarray(float(v)) for n, v in full.items()})
    return Rolled(params, d, second, x[:, 0], x[:, 1], rng)


def near(value: float, rng: np.random.Generator, factor: float = 2.0) -> Free:
    """Return a start that is off by up to a factor in either direction."""
    return Free(float(value * factor ** rng.uniform(-1, 1)))


def of_roll(
    r: Rolled,
    free: Sequence[str],
    flights: Sequence[Flight],
    nuisance: Nuisance = NO_OFFSET,
    starts: Mapping[str, Free] | None = None,
) -> Problem:
    starts = starts or {}
    frees = {n: starts.get(n) or near(float(getattr(r.params, n)) or 1.0, r.rng) for n in free}
    return Problem(ROLL, r.params, flights, frees, nuisance)


def true(r: Rolled, *names: str) -> dict[str, float]:
    return {n: float(getattr(r.params, n)) for n in names}


def other(d: np.ndarray, rng: Any) -> np.ndarray:
    """Return a second input that moves independently."""
    return random_steps(d.size, DT, rng, (0.2, 1.0))


# Sound problems.


def plain(seed: int) -> Puzzle:
    r = rolled(seed)
    return Puzzle(
        "damping and effectiveness", of_roll(r, ("Lp", "Ld"), [r.flight("p")]), true(r, "Lp", "Ld")
    )


def wrong_sign(seed: int) -> Puzzle:
    r = rolled(seed)
    name = ("Lp", "Ld")[seed % 2]
    # With a wrong sign of damping a long record diverges, so the start is near zero, as a user
    # would choose.
    start = Free(-float(getattr(r.params, name)) * (0.05 if name == "Lp" else 0.7))
    problem = of_roll(r, ("Lp", "Ld"), [r.flight("p")], starts={name: start})
    return Puzzle(f"start of {name} of the wrong sign", problem, true(r, "Lp", "Ld"))


def gain_known(seed: int) -> Puzzle:
    r = rolled(seed, k=1.7)
    return Puzzle("gain known", of_roll(r, ("Lp", "Ld"), [r.flight("p")]), true(r, "Lp", "Ld"))


def two_inputs(seed: int) -> Puzzle:
    r = rolled(seed, other, Le=12.0)
    problem = of_roll(r, ("Lp", "Ld", "Le"), [r.flight("p", "phi")])
    return Puzzle("two inputs", problem, true(r, "Lp", "Ld", "Le"))


def alike_inputs(seed: int) -> Puzzle:
    r = rolled(seed, lambda d, rng: 0.9 * d + 0.4 * other(d, rng), Le=12.0)
    problem = of_roll(r, ("Lp", "Ld", "Le"), [r.flight("p")])
    return Puzzle("two inputs much alike", problem, true(r, "Lp", "Ld", "Le"))


def constant_known_bias(seed: int) -> Puzzle:
    r = rolled(seed, L0=6.0)
    nuisance = Nuisance(bias=False, input_offset=False)
    problem = of_roll(r, ("Lp", "Ld", "L0"), [r.flight("p")], nuisance)
    return Puzzle("constant term without bias", problem, true(r, "Lp", "Ld", "L0"))


def constant_in_angle(seed: int) -> Puzzle:
    r = rolled(seed, L0=6.0)
    problem = of_roll(r, ("Lp", "Ld", "L0"), [r.flight("phi")])
    return Puzzle("constant term seen in the angle", problem, true(r, "Lp", "Ld", "L0"))


def zero_truth(seed: int) -> Puzzle:
    r = rolled(seed, other, Le=0.0)
    problem = of_roll(r, ("Lp", "Ld", "Le"), [r.flight("p")], starts={"Le": Free(5.0)})
    return Puzzle("a parameter that is zero", problem, true(r, "Lp", "Ld", "Le"))


def half_missing(seed: int) -> Puzzle:
    r = rolled(seed)
    flight = r.flight("p")
    y = np.where(r.rng.uniform(size=N) < 0.45, np.nan, flight.outputs["p"])
    flight = Flight(dt=DT, inputs=flight.inputs, outputs={"p": y})
    return Puzzle(
        "half of the samples missing", of_roll(r, ("Lp", "Ld"), [flight]), true(r, "Lp", "Ld")
    )


def offset(seed: int) -> Puzzle:
    r = rolled(seed)
    flight = r.flight("phi")
    inputs = {"d": flight.inputs["d"] - 0.05, "e": flight.inputs["e"]}
    flight = Flight(dt=DT, inputs=inputs, outputs=flight.outputs)
    problem = of_roll(r, ("Lp", "Ld"), [flight], Nuisance())
    return Puzzle("stick off its centre", problem, true(r, "Lp", "Ld"))


def short_period(seed: int) -> Puzzle:
    rng = np.random.default_rng(seed)
    v = {"Zw": -rng.uniform(1, 2), "Mw": -rng.uniform(0.1, 0.3), "Mq": -rng.uniform(2, 4)}
    v |= {"Md": -rng.uniform(5, 15), "V": 20.0}
    u = random_steps(N, DT, rng, (0.2, 1.0))
    x = stepped([[v["Zw"], v["V"]], [v["Mw"], v["Mq"]]], [[0.0], [v["Md"]]], u[:, None], [0.0, 0.0])
    y = x + 0.01 * x.std(axis=0) * rng.standard_normal(x.shape)
    outputs = {"w": y[:, 0], "q": y[:, 1]} if seed % 2 else {"q": y[:, 1]}
    params = PitchParams(**{n: jnp.asarray(c) for n, c in v.items()})
    flight = Flight(dt=DT, inputs={"d": u}, outputs=outputs)
    free = {n: near(v[n], rng, 1.5) for n in ("Zw", "Mw", "Mq", "Md")}
    problem = Problem(PITCH, params, [flight], free, NO_OFFSET)
    return Puzzle("short period", problem, {n: v[n] for n in free})


def bench(seed: int, stand: bool = True) -> tuple[Any, Flight, np.random.Generator]:
    """Return a record of the roll model, from eq. 23."""
    rng = np.random.default_rng(seed)
    machine = load_vehicle(Path(__file__).parents[1] / "configs" / "vehicles" / "bench-30.yaml")
    H = roll_transfer_function(machine, stand=stand)
    held: Any = scipy.signal.cont2discrete((np.array(H.num), np.array(H.den)), DT)
    u = 3e-6 * random_steps(4 * N, DT, rng, (0.2, 1.5))
    y = scipy.signal.lfilter(np.ravel(held[0]), held[1], u)
    y = y + 2e-3 * rng.standard_normal(u.size)
    return machine, Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y}), rng


def on_the_stand(seed: int) -> Puzzle:
    machine, flight, _ = bench(seed)
    free = {"Ixx": Free(0.05), "If": Free(5e-4)}
    problem = Problem(models.roll_on_stand, machine, [flight], free)
    return Puzzle("roll on the stand", problem, {n: float(getattr(machine, n)) for n in free})


def with_prior(seed: int) -> Puzzle:
    machine, flight, rng = bench(seed)
    prior = Prior(float(machine.a) + 0.1 * rng.standard_normal(), 0.1)
    free = {"Ixx": Free(0.05), "If": Free(5e-4), "a": Free(5.0, prior=prior)}
    problem = Problem(models.roll_on_stand, machine, [flight], free)
    return Puzzle("a known beforehand", problem, {n: float(getattr(machine, n)) for n in free})


# Problems that are not sound.


def exchangeable(seed: int) -> Puzzle:
    r = rolled(seed, L0=6.0)
    # Without bounds a parameter only has a scale; bounds of different sign give it an interval.
    starts = {"L0": Free(1.0, -50.0, 50.0)} if seed % 2 else {}
    problem = of_roll(r, ("Lp", "Ld", "L0"), [r.flight("p")], starts=starts)
    return Puzzle("constant term, bias and initial state", problem, true(r, "Lp", "Ld"), ("L0",))


def product(seed: int) -> Puzzle:
    r = rolled(seed, k=1.7)
    problem = of_roll(r, ("Lp", "Ld", "k"), [r.flight("p")])
    return Puzzle("gain times effectiveness", problem, true(r, "Lp"), ("Ld", "k"))


def gain_nuisance(seed: int) -> Puzzle:
    r = rolled(seed, other, Le=12.0)
    nuisance = Nuisance(input_gain=True, input_offset=False)
    problem = of_roll(r, ("Lp", "Ld"), [r.flight("p")], nuisance)
    return Puzzle("estimated gain times effectiveness", problem, true(r, "Lp"), ("Ld",))


def total(seed: int) -> Puzzle:
    r = rolled(seed, Lp=-2.0, Lq=-1.5)
    problem = of_roll(r, ("Lp", "Lq", "Ld"), [r.flight("p")])
    return Puzzle("sum of two dampings", problem, true(r, "Ld"), ("Lp", "Lq"))


def dead_input(seed: int) -> Puzzle:
    r = rolled(seed, lambda d, rng: np.full(d.size, 0.0), Le=12.0)
    problem = of_roll(r, ("Lp", "Ld", "Le"), [r.flight("p")])
    return Puzzle("an input that never moves", problem, true(r, "Lp", "Ld"), ("Le",))


def same_inputs(seed: int) -> Puzzle:
    r = rolled(seed, lambda d, rng: 0.5 * d, Le=12.0)
    problem = of_roll(r, ("Lp", "Ld", "Le"), [r.flight("p")])
    return Puzzle("two inputs in one", problem, true(r, "Lp"), ("Ld", "Le"))


def nearly_same_inputs(seed: int) -> Puzzle:
    r = rolled(seed, lambda d, rng: 0.5 * d + 1e-5 * other(d, rng), Le=12.0)
    problem = of_roll(r, ("Lp", "Ld", "Le"), [r.flight("p", noise=0.05)])
    return Puzzle("two inputs all but in one", problem, true(r, "Lp"), ("Ld", "Le"))


def too_short(seed: int) -> Puzzle:
    """A vehicle with a time constant of a thousand seconds, in twelve seconds of noise."""
    r = rolled(seed, Lp=-0.001, Ld=0.5)
    problem = of_roll(r, ("Lp", "Ld"), [r.flight("p", noise=0.3)])
    return Puzzle("record too short for the damping", problem, {}, hardly=true(r, "Lp"))


def paper(seed: int) -> Puzzle:
    machine, flight, _ = bench(seed)
    free = {"Ixx": Free(0.05), "If": Free(5e-4), "a": Free(5.0)}
    problem = Problem(models.roll_on_stand, machine, [flight], free)
    return Puzzle("the paper's three parameters", problem, {}, tuple(free))


def no_excitation(seed: int) -> Puzzle:
    """Only noise, since no output shows the input's single move."""
    r = rolled(seed, Ld=1e-6)
    measured = {"p": 0.1 * r.rng.standard_normal(N)}
    flight = Flight(dt=DT, inputs={"d": r.d, "e": r.e}, outputs=measured)
    problem = of_roll(r, ("Lp",), [flight])
    return Puzzle("no excitation", problem, {}, ("Lp",), adequate=False)


def something_else(seed: int) -> Puzzle:
    """An output that is unrelated to the input."""
    r = rolled(seed)
    drift = np.cumsum(r.rng.standard_normal(N))
    flight = Flight(dt=DT, inputs={"d": r.d, "e": r.e}, outputs={"p": drift})
    return Puzzle("a record of something else", of_roll(r, ("Lp",), [flight]), {}, adequate=False)


def swapped_sign(seed: int) -> Puzzle:
    """The output has the wrong sign, and bounds fix the parameters' signs."""
    r = rolled(seed, Ld=40.0)
    flight = r.flight("p")
    flight = Flight(dt=DT, inputs=flight.inputs, outputs={"p": -flight.outputs["p"]})
    starts = {"Ld": Free(30.0, 1.0, 200.0), "Lp": Free(-4.0, -50.0, -0.1)}
    problem = of_roll(r, ("Lp", "Ld"), [flight], starts=starts)
    return Puzzle("an output of the wrong sign", problem, {}, adequate=False)


SOUND: tuple[tuple[Callable[[int], Puzzle], int], ...] = (
    (plain, 6), (wrong_sign, 6), (gain_known, 3), (two_inputs, 4), (alike_inputs, 4),
    (constant_known_bias, 4), (constant_in_angle, 4), (zero_truth, 3), (half_missing, 4),
    (offset, 4), (short_period, 4), (on_the_stand, 2), (with_prior, 2),
)  # fmt: skip
UNSOUND: tuple[tuple[Callable[[int], Puzzle], int], ...] = (
    (exchangeable, 6), (product, 5), (gain_nuisance, 4), (total, 5), (dead_input, 5),
    (same_inputs, 4), (nearly_same_inputs, 4), (too_short, 4), (paper, 3), (no_excitation, 3),
    (something_else, 4), (swapped_sign, 3),
)  # fmt: skip


def zoo(small: bool = False) -> Iterator[Puzzle]:
    """Yield all hundred problems, or one of each kind."""
    for kind, count in (*SOUND, *UNSOUND):
        for seed in range(1 if small else count):
            yield kind(seed)


def complaint(puzzle: Puzzle, result: Fit) -> str:
    """Return the error of a fit's answer; empty if it is right."""
    if not puzzle.adequate:
        if result.status == "converged" and result.adequate:
            return "silent success: converged and adequate"
        return ""
    for name, value in puzzle.hardly.items():
        e = result.estimates[name]
        if e.sd is None or e.lower95 is None or e.upper95 is None:
            continue
        if not (e.lower95 < min(value, 0.0) and e.upper95 > max(value, 0.0)):
            return f"silent success: {name} is {e.value:.4g} +- {e.sd:.2g}"
    if puzzle.hardly:
        return ""
    if puzzle.not_identifiable:
        reported = [n for n in puzzle.not_identifiable if result.estimates[n].sd is not None]
        if result.status == "converged" or reported:
            return f"silent success: {result.status}, {', '.join(reported)} given"
        if result.status != "not-identifiable":
            return f"not said: {result.status}"
        return _off(puzzle, result)
    if result.status != "converged":
        return f"false alarm: {result.status}"
    if not result.adequate:
        return "false alarm: not adequate"
    return _off(puzzle, result)


def _off(puzzle: Puzzle, result: Fit) -> str:
    """Return which determined parameter is wrong."""
    for name, value in puzzle.truth.items():
        e = result.estimates[name]
        if e.sd is None:
            return f"false alarm: {name} not determined"
        if abs(e.value - value) > 5 * e.sd:
            return f"wrong: {name} is {e.value:.4g} +- {e.sd:.2g}, not {value:.4g}"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one of each kind")
    parser.add_argument("--only", default="", help="kinds whose name has these words in it")
    options = parser.parse_args()
    begin, count, wrong = time.monotonic(), 0, 0
    for puzzle in zoo(options.quick):
        if options.only not in puzzle.name:
            continue
        result = fit(puzzle.problem)
        said = complaint(puzzle, result)
        count, wrong = count + 1, wrong + bool(said)
        print(f"{'WRONG' if said else 'right'}  {puzzle.name}: {said or result.status}", flush=True)
    print(f"{count - wrong} of {count} right, {time.monotonic() - begin:.0f} s")
    return int(wrong > 0)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
