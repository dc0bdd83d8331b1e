"""Results of runs in a sweep, against simulate, NumPy and numbers by hand."""

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Model, linearize, models, naming, simulate, sweep
from heli_jax.analysis.linear import modes
from heli_jax.analysis.trim import Condition, trim
from heli_jax.control.pilot import attitude_hold
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.validation.metrics import metrics
from heli_jax.simulation.accumulate import accumulated
from heli_jax.sweeps import (
    Range,
    Reduce,
    Streaming,
    Trajectories,
    Trimmed,
    grid,
    paired,
    product,
    sobol,
)
from heli_jax.sweeps.design_point import DIVERGED, OK, OUT_OF_RANGE
from heli_jax.sweeps.reducers import REDUCERS

ROLL = models.roll_on_stand
AXES = {"Ixx": Range(0.02, 0.05, "log"), "If": Range(2e-4, 6e-4, "log")}


def flown(model, record, **options):
    """Return simulate, compiled once for all that use this record."""
    return jax.jit(lambda params: simulate(model, params, record, **options))


@pytest.mark.parametrize("solver", ["exact", "rk4"])
def test_every_reducer_is_what_numpy_makes_of_the_run(bench30, record, solver):
    reduce = {how: Reduce(how, "roll") for how in REDUCERS}
    found = sweep(ROLL, bench30, record, sobol(AXES, 5), reduce, solver=solver)
    measured = record.outputs["roll"]
    fly = flown(ROLL, record)
    for k in range(5):
        own = {n: jnp.asarray(float(found[n][k])) for n in AXES}
        y = np.asarray(fly(naming.replace(bench30, **own)).outputs.roll)
        agreed = metrics(measured, y)
        wanted = {
            "rms": np.sqrt(np.mean(y**2)),
            "mean": np.mean(y),
            "peak": np.max(np.abs(y)),
            "max": y.max(),
            "min": y.min(),
            "final": y[-1],
            "rmse": agreed.rmse,
            "nrmse": 1.0 - agreed.nrmse_fit_percent / 100.0,
            "fit": agreed.nrmse_fit_percent,
            "vaf": agreed.vaf,
            "tic": agreed.tic,
        }
        assert set(wanted) == set(REDUCERS)
        rtol = 1e-9 if solver == "exact" else 1e-6
        for how, value in wanted.items():
            np.testing.assert_allclose(found[how][k], value, rtol=rtol, atol=1e-9, err_msg=how)
    assert found["status"].dtype == np.uint8
    assert not found["status"].any()


def test_the_labels_say_what_stands_there(bench30, record):
    reduce = {"peak": Reduce("peak", "roll"), "fit": Reduce("fit", "roll")}
    axes = {"Ixx": Range(0.02, 0.05, "log", 4), "Iyy": [0.1], "gain.x_roll": [1.0]}
    found = sweep(ROLL, bench30, [record, record], grid(axes), reduce)
    assert found["flight"].values.tolist() == [f"{record.name} ({k})" for k in (1, 2)]
    assert list(found) == ["peak", "fit"]
    assert found["Ixx"].attrs["scale"] == "log"
    assert "scale" not in found["Iyy"].attrs
    # An axis without effect has a note.
    [said] = found.attrs["notes"]
    assert (said["code"], said["subjects"]) == ("sweep.axis-without-effect", ["Iyy"])
    assert found["peak"].attrs["units"] == "rad"
    assert found["fit"].attrs["units"] == "%"
    assert found["Ixx"].attrs["units"] == "kg m^2"
    assert found["Ixx"].dims == ("element",)
    assert set(found.coords) == {*axes, "flight", "status"}
    assert found["status"].attrs["flag_meanings"].split()[:3] == ["ok", "diverged", "out_of_range"]
    assert found.attrs["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize(("samples", "block"), [(2, 4), (5, 4), (9, 8)])
def test_blocks_of_samples_lose_none(bench30, record, samples, block):
    flight = Flight(
        dt=0.02, inputs={"x_roll": record.inputs["x_roll"][:samples] + 1e-6}, outputs={}
    )
    order = jnp.arange(1.0, samples + 1.0)

    def update(value, outputs, k):
        return (value[0] + k * outputs.roll, value[1] + k)

    found = accumulated(
        ROLL, bench30, flight, update, (jnp.zeros(()), jnp.zeros(())), data=order, block=block,
    )  # fmt: skip
    run = simulate(ROLL, bench30, flight)
    np.testing.assert_allclose(found.value[0], np.sum(order * run.outputs.roll), rtol=1e-10)
    assert found.value[1] == samples * (samples + 1) / 2
    for name, v in naming.asdict(found.state).items():
        np.testing.assert_allclose(v, getattr(run.states, name)[-1], rtol=1e-9, atol=1e-18)


class Rate(NamedTuple):
    gain: Annotated[float, "1/s^2", "control power"]
    lag: Annotated[float, "1/s", "damping"]


class Turning(NamedTuple):
    p: Annotated[float, "rad/s", "rate"]


class Stick(NamedTuple):
    u: Annotated[float, "1", "stick"]
    v: Annotated[float, "1", "another"]


class Felt(NamedTuple):
    p: Annotated[float, "rad/s", "rate"]
    felt: Annotated[float, "rad/s^2", "acceleration, which the stick moves directly"]


def own_model(linear=True):
    def field(q, x, u):
        return Turning(-q.lag * x.p + q.gain * (u.u + 2.0 * u.v))

    return Model(
        "own", field, lambda q, x, u: Felt(x.p, field(q, x, u).p), Rate, Turning, Stick, Felt,
        linear=linear,
    )  # fmt: skip


@pytest.fixture
def pushed():
    rng = np.random.default_rng(0)
    inputs = {n: rng.standard_normal(41) for n in ("u", "v")}
    return Flight(dt=0.1, inputs=inputs, outputs={}, name="pushed")


def test_a_model_of_ones_own_with_direct_feedthrough(pushed):
    model, params = own_model(), Rate(2.0, 0.5)
    axes = {"lag": [0.25, 1.0, 4.0], "initial.p": [-1.0, 0.0, 2.0], "gain.u": [1.0, 2.0, 0.5]}
    axes |= {"offset.v": [0.0, 0.1, -0.2]}
    reduce = {"last": Reduce("final", "felt"), "rms": Reduce("rms", "felt")}
    found = sweep(model, params, pushed, paired(axes), reduce)
    for k in range(3):
        lag, x = axes["lag"][k], axes["initial.p"][k]
        u = axes["gain.u"][k] * pushed.inputs["u"] + 2.0 * (
            pushed.inputs["v"] + axes["offset.v"][k]
        )
        felt = []
        for now in u:  # the exact step of a first-order lag, by hand
            felt.append(2.0 * now - lag * x)
            x = x * np.exp(-0.1 * lag) + 2.0 * now * (1.0 - np.exp(-0.1 * lag)) / lag
        np.testing.assert_allclose(found["last"][k], felt[-1], rtol=1e-10)
        np.testing.assert_allclose(found["rms"][k], np.sqrt(np.mean(np.square(felt))), rtol=1e-10)


def test_the_inputs_may_come_later(bench30, record):
    found = sweep(
        ROLL, bench30, record, paired({"delay": [0.0, 0.013, 0.1]}), {"p": Reduce("rms", "roll")}
    )
    for k, late in enumerate([0.0, 0.013, 0.1]):
        run = simulate(ROLL, bench30, record, delay=jnp.asarray(late))
        np.testing.assert_allclose(found["p"][k], np.sqrt(np.mean(run.outputs.roll**2)), rtol=1e-9)


@pytest.mark.slow
def test_a_seed_draws_the_disturbance(bench30, record):
    model = with_disturbance(ROLL, "roll")
    params = model.Params(
        **{**naming.asdict(bench30), "sigma_w": jnp.asarray(1.0), "tau_w": jnp.asarray(1.0)}
    )
    design = product(paired({"seed": [4, 5]}), paired({"sigma_w": [0.0, 1.0]}))
    found = sweep(model, params, record, design, {"rms": Reduce("rms", "roll")})
    assert found.attrs["notes"] == []
    quiet = simulate(ROLL, bench30, record).outputs.roll
    still = np.sqrt(np.mean(quiet**2))
    np.testing.assert_allclose(found["rms"].values[[0, 2]], still, rtol=1e-9)
    for k, seed in ((1, 4), (3, 5)):
        run = simulate(model, params, record, key=jax.random.key(seed))
        np.testing.assert_allclose(found["rms"][k], np.sqrt(np.mean(run.outputs.roll**2)))
    assert found["rms"][1] != found["rms"][3]


def peak_and_when(run):
    k = jnp.argmax(jnp.abs(run.outputs.roll))
    return {"size": jnp.abs(run.outputs.roll[k]), "time": run.times[k]}


def test_functions_of_ones_own(bench30, record):
    sums = Streaming(0.0, lambda v, y, _: v + y.roll, lambda v, n, _: v / n, unit="rad")
    reduce = {"peak": Reduce(peak_and_when), "mean": Reduce(sums), "other": Reduce("mean", "roll")}
    found = sweep(
        ROLL, bench30, record, grid({"Ixx": [0.02, 0.04]}), reduce,
        trajectories=Trajectories(("roll",), 7),
    )  # fmt: skip
    fly = flown(ROLL, record)
    for k, Ixx in enumerate([0.02, 0.04]):
        run = fly(naming.replace(bench30, Ixx=jnp.asarray(Ixx)))
        y = np.asarray(run.outputs.roll)
        np.testing.assert_allclose(found["peak_size"][k], np.max(np.abs(y)))
        assert found["peak_time"][k] == np.asarray(run.times)[np.argmax(np.abs(y))]
        np.testing.assert_allclose(found["mean"][k], y.mean(), rtol=1e-9)
        np.testing.assert_allclose(found["other"][k], y.mean(), rtol=1e-9)
        np.testing.assert_allclose(found["trajectory_roll"][k], y[::7])
    np.testing.assert_allclose(found["time"], record.times[::7])
    assert found["trajectory_roll"].dims == ("element", "time")
    assert found["trajectory_roll"].attrs["units"] == "rad"


def test_modes_and_margins_are_those_of_the_matrices(bench30, record):
    control = pytest.importorskip("control")
    reduce = {
        "mode": Reduce("modes"),
        "loop": Reduce("margins", "roll", input="x_roll", gain=2e-6),
    }
    found = sweep(ROLL, bench30, record, grid({"Ixx": [0.02, 0.05]}), reduce)
    for k, Ixx in enumerate([0.02, 0.05]):
        params = naming.replace(bench30, Ixx=jnp.asarray(Ixx))
        values = modes(ROLL, params)
        mine = found["mode_real"].values[k] + 1j * found["mode_imag"].values[k]
        np.testing.assert_allclose(np.sort_complex(mine), np.sort_complex(values), rtol=1e-9)
        assert np.all(np.diff(np.abs(mine)) > -1e-9)
        loop = 2e-6 * linearize(ROLL, params).to_control()[0, 0]
        gm, pm, _, _, _, _ = control.stability_margins(loop, returnall=True)
        assert found["loop_stable"][k] == 1
        if gm.size:
            wanted = np.min(np.abs(20 * np.log10(gm)))
            np.testing.assert_allclose(found["loop_gain"][k], wanted, rtol=1e-5)
        else:
            assert np.isinf(found["loop_gain"][k])
        if pm.size:
            np.testing.assert_allclose(found["loop_phase"][k], np.min(np.abs(pm)), rtol=1e-5)
        else:
            assert np.isinf(found["loop_phase"][k])


def test_several_flights_are_a_dimension(bench30, record):
    other = Flight(
        dt=0.02,
        inputs={"x_roll": -2.0 * record.inputs["x_roll"][:100]},
        outputs={"roll": np.ones(100)},
        known={"Ixx_added": 0.01},
        name="heavier",
    )
    reduce = {"rms": Reduce("rms", "roll"), "misfit": Reduce("rmse", "roll")}
    both = sweep(ROLL, bench30, [record, other], sobol(AXES, 4), reduce)
    assert both["rms"].dims == ("element", "flight")
    assert both["flight"].values.tolist() == ["bench", "heavier"]
    for i, flight in enumerate((record, other)):
        one = sweep(ROLL, bench30, flight, sobol(AXES, 4), reduce)
        np.testing.assert_array_equal(both["rms"][:, i], one["rms"])
        np.testing.assert_array_equal(both["misfit"][:, i], one["misfit"])


def test_exactly_the_bad_elements_are_flagged(bench30, record):
    n = 3000
    rng = np.random.default_rng(8)
    Ixx = rng.uniform(0.02, 0.05, n)
    lost, huge = np.arange(17, n, 1000), np.arange(500, n, 1000)
    impossible = np.arange(900, n, 1000)
    kick = np.zeros(n)
    good = sweep(
        ROLL, bench30, record, paired({"Ixx": Ixx, "initial.phi": kick}),
        {"rms": Reduce("rms", "roll")},
    )  # fmt: skip
    Ixx = Ixx.copy()
    Ixx[lost], Ixx[impossible], kick[huge] = np.nan, -0.03, 1e200
    found = sweep(
        ROLL, bench30, record, paired({"Ixx": Ixx, "initial.phi": kick}),
        {"rms": Reduce("rms", "roll")},
    )  # fmt: skip
    wanted = np.full(n, OK)
    wanted[lost], wanted[huge], wanted[impossible] = DIVERGED, DIVERGED, OUT_OF_RANGE
    np.testing.assert_array_equal(found["status"], wanted)
    assert np.all(np.isnan(found["rms"].values[wanted == DIVERGED]))
    fine = wanted == OK
    np.testing.assert_array_equal(found["rms"].values[fine], good["rms"].values[fine])


def test_a_model_that_runs_away_is_flagged(pushed):
    model = own_model(linear=False)
    design = paired({"lag": [0.5, -50.0, 1.0, -1000.0]})
    found = sweep(model, Rate(2.0, 0.5), pushed, design, {"end": Reduce("final", "p")})
    assert found["status"].values.tolist() == [OK, DIVERGED, OK, DIVERGED]


@pytest.fixture(scope="module")
def xcell(vehicles_folder):
    from heli_jax import load_vehicle

    return load_vehicle(vehicles_folder / "x-cell-60.yaml")


# With one length and one condition, the trim is compiled once.
HELICOPTER = models.helicopter("consistent")
STILL = Flight(
    dt=0.02, inputs={n: np.zeros(51) for n in naming.names(HELICOPTER.Inputs)}, outputs={},
    name="still",
)  # fmt: skip
AHEAD = Condition(forward_speed=10.0)


@pytest.mark.slow
def test_helicopters_begin_in_a_trim_of_their_own(xcell):
    model, heavy = HELICOPTER, 100.0
    design = paired({"m": [float(xcell.m), 1.2 * float(xcell.m), heavy]})
    reduce = {
        "sinks": Reduce("final", "dz"), "turns": Reduce("peak", "roll"), "mode": Reduce("modes"),
    }  # fmt: skip
    found = sweep(model, xcell, STILL, design, reduce, trimmed=Trimmed(AHEAD))
    assert found["status"].values.tolist() == [OK, OK, OUT_OF_RANGE]
    np.testing.assert_allclose(found["sinks"][:2], 0.0, atol=1e-9)
    for k in range(2):
        params = naming.replace(xcell, m=jnp.asarray(float(found["m"][k])))
        at = trim(model, params, AHEAD)
        phi = abs(float(at.state.phi))
        np.testing.assert_allclose(found["turns"][k], phi, rtol=1e-6, atol=1e-12)
        values = modes(model, params, at.state, at.inputs)
        mine = found["mode_real"].values[k] + 1j * found["mode_imag"].values[k]
        np.testing.assert_allclose(np.sort(np.abs(mine)), np.sort(np.abs(values)), atol=1e-5)


@pytest.mark.slow
def test_the_pilot_holds_each_element_in_its_own_trim(xcell):
    model = HELICOPTER
    pilot = attitude_hold(model, xcell, trim(model, xcell, AHEAD))
    design = paired({"m": [0.7 * float(xcell.m), float(xcell.m), 1.3 * float(xcell.m)]})
    reduce = {n: Reduce("final", n) for n in ("roll_rate", "y", "z")}
    found = sweep(model, xcell, STILL, design, reduce, trimmed=Trimmed(AHEAD), pilot=pilot)
    assert not found["status"].any()
    for name in reduce:
        np.testing.assert_allclose(found[name], 0.0, atol=1e-9)
