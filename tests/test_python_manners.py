"""Use from scripts: pickling, the version, and errors that state what to pass."""

import pickle
import subprocess
import sys
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import heli_jax
from heli_jax import Flight, Free, Problem, linear_model, models, simulate
from heli_jax.sweeps import grid

LINEAR = linear_model("roll-flybarless")
PARAMS = LINEAR.vehicle().params
U = {"lat": np.sin(0.1 * np.arange(200))}
FLIGHT = Flight(
    inputs=U, outputs={"p": np.zeros(200)}, dt=0.02, sd={"p": 0.1}, hold={"lat": "zero-order"}
)
FREE = {"Lb": Free(100.0)}
WRONG: Any = Free
"""Arguments that the types forbid."""


@pytest.mark.parametrize(
    "model", [models.roll, models.roll_on_stand, models.helicopter("full"), LINEAR.model]
)
def test_models_come_through_pickle(model: heli_jax.Model) -> None:
    again = pickle.loads(pickle.dumps(model))
    assert again.name == model.name
    assert again.Params._fields if hasattr(model.Params, "_fields") else again.Params
    # Built by keyword, as before.
    state = again.State(**dict.fromkeys(heli_jax.naming.names(model.State), 0.5))
    assert pickle.loads(pickle.dumps(state)) == state


def test_a_problem_goes_to_another_process_and_simulates_there() -> None:
    problem = Problem(LINEAR.model, PARAMS, [FLIGHT], FREE)
    expected = simulate(problem.model, problem.vehicle, problem.flights[0]).outputs.p
    code = (
        "import sys, pickle, jax; jax.config.update('jax_enable_x64', True)\n"
        "from heli_jax import simulate\n"
        "p = pickle.load(sys.stdin.buffer)\n"
        "y = simulate(p.model, p.vehicle, p.flights[0]).outputs.p\n"
        "sys.stdout.write(repr(float(y[-1])))"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(problem), capture_output=True, check=True
    )
    assert float(run.stdout) == pytest.approx(float(expected[-1]), rel=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [
        (LINEAR.model, "heli.yaml", [FLIGHT], FREE),
        (LINEAR.model, object(), [FLIGHT], FREE),
        (LINEAR.model, PARAMS, FLIGHT, FREE),
        (LINEAR.model, PARAMS, ["flight.csv"], FREE),
        (LINEAR.model, PARAMS, [FLIGHT], {"Lb": 100.0}),
        (LINEAR.model, PARAMS, [FLIGHT], ["Lb"]),
        (LINEAR.model, PARAMS, [FLIGHT], {"Lb": WRONG("100")}),
        (LINEAR.model, PARAMS, [FLIGHT], {"Lb": WRONG(True)}),
        (LINEAR.model, PARAMS, [FLIGHT], {"Lb": WRONG(9.0, "0")}),
        (LINEAR.model, PARAMS, [FLIGHT], {"Lb": WRONG(9.0, prior=(9, 1))}),
    ],
)
def test_a_wrong_argument_is_told_what_to_pass(arguments: tuple) -> None:
    with pytest.raises(TypeError):
        Problem(*arguments)


def test_numbers_of_numpy_and_jax_are_numbers() -> None:
    free = {"Lb": Free(np.float32(100.0), lower=jnp.asarray(1.0), upper=np.asarray(1000.0))}  # pyright: ignore[reportArgumentType]
    assert Problem(LINEAR.model, PARAMS, [FLIGHT], free).free["Lb"].start == 100.0


@pytest.mark.parametrize(
    ("model", "params", "flight", "dt"),
    [
        (LINEAR.model, PARAMS, U, 0.02),
        (LINEAR.model, PARAMS, U["lat"], 0.02),
        (LINEAR.model, "heli.yaml", FLIGHT, None),
        (LINEAR.model, PARAMS, FLIGHT, -0.02),
        (LINEAR.model, PARAMS, FLIGHT, 0.0),
        (LINEAR.model, PARAMS, FLIGHT, float("nan")),
    ],
)
def test_simulate_says_what_to_pass(model, params, flight, dt) -> None:
    with pytest.raises((TypeError, ValueError)):
        simulate(model, params, flight, dt=dt)


@pytest.mark.parametrize(
    "changes",
    [
        {"inputs": U["lat"]},
        {"dt": "0.02"},
        {"outputs": {"p": np.zeros(200, complex)}},
    ],
)
def test_a_flight_says_what_to_pass(changes) -> None:
    with pytest.raises((TypeError, ValueError)):
        Flight(**{"inputs": U, "outputs": {"p": np.zeros(200)}, "dt": 0.02} | changes)


def test_a_configuration_is_no_problem() -> None:
    with pytest.raises(TypeError, match="load_config"):
        heli_jax.fit("configs/bench-roll.yaml")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="by_name"):
        simulate("roll", PARAMS, U)  # pyright: ignore[reportArgumentType]


def test_angles_of_more_than_a_turn_are_warned_of() -> None:
    turning = Flight(
        inputs=U, outputs={"phi": np.linspace(-40.0, 40.0, 200)}, dt=0.02, sd={"phi": 1.0},
        hold={"lat": "zero-order"},
    )  # fmt: skip
    with pytest.warns(UserWarning, match="np.radians"):
        Problem(LINEAR.model, PARAMS, [turning], FREE)


def _banked(phi: np.ndarray) -> Problem:
    flight = Flight(
        inputs=U, outputs={"phi": phi}, dt=0.02, sd={"phi": 1.0}, hold={"lat": "zero-order"}
    )
    return Problem(LINEAR.model, PARAMS, [flight], FREE)


def test_angles_that_turn_faster_than_a_helicopter_are_warned_of() -> None:
    t = 0.02 * np.arange(200)
    # 15 degrees to either side at 0.8 Hz; taken as radians it would be 75 rad/s.
    with pytest.warns(UserWarning, match="implausible for a helicopter.*np.radians"):
        _banked(15.0 * np.sin(5.0 * t))
    # A full roll in half a second, with a continuous and a wrapped angle; and the drift of a linear
    # model.
    rolled = np.interp(t, [1.0, 1.5], [0.0, 2.0 * np.pi])
    for phi in (rolled, (rolled + np.pi) % (2.0 * np.pi) - np.pi, 4.0 * t):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            _banked(phi)


@pytest.mark.parametrize(
    "call",
    [
        lambda: heli_jax.run_fit(WRONG),
        lambda: heli_jax.load_fit(WRONG),
        lambda: heli_jax.intervals(WRONG),
        lambda: heli_jax.write_report(WRONG, "out"),
        lambda: _sweep({"Lb": [1, 2]}, {}),
        lambda: _sweep(grid({"Lb": [1, 2]}), {"rms": "rms"}),
    ],
)
def test_another_kind_is_refused_in_words(call) -> None:
    with pytest.raises(TypeError):
        call()


def _sweep(design: Any, reduce: Any) -> None:
    heli_jax.sweep(LINEAR.model, PARAMS, FLIGHT, design, reduce)


def test_a_fit_in_single_precision_is_refused() -> None:
    """Test filter error on a sound record in a loop, which once ended with exit code 4."""
    code = (
        "import numpy as np\n"
        "from heli_jax import Flight, Free, Problem, check, fit, linear_model\n"
        "linear = linear_model('roll-flybarless')\n"
        "u = {'lat': np.sin(0.1 * np.arange(200))}\n"
        "flight = Flight(dt=0.02, inputs=u, outputs={'p': np.zeros(200)})\n"
        "problem = Problem(linear.model, linear.vehicle().params, [flight], {'Lb': Free(100.0)})\n"
        "for call in (check, fit):\n"
        "    try:\n"
        "        call(problem)\n"
        "    except ValueError as e:\n"
        "        print('jax_enable_x64' in str(e))\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["True", "True"]
