"""Holds of inputs on the command line: simulate, check, fit and a sweep."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from heli_jax import Flight, load_vehicle, models, naming, simulate, sweep
from heli_jax.cli import main
from heli_jax.sweeps import Reduce, Trajectories, grid

ROOT = Path(__file__).parents[1]
KEY = "flights.0.signals.inputs.x_roll.hold"


@pytest.fixture(scope="module")
def chirped(tmp_path_factory):
    """Return the demo's bench with a chirp, and its log."""
    folder = tmp_path_factory.mktemp("chirp")
    content = yaml.safe_load((ROOT / "configs" / "bench-gusts.yaml").read_text())
    content["vehicle"] = str(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    content["flights"][0]["log"] = "bench.csv"
    del content["disturbance"]
    content["rls"] = None
    content["simulate"]["duration"] = 20  # 1000 samples, as in other tests
    content["simulate"]["inputs"]["x_roll"] |= {"kind": "chirp", "amplitude": 10.0}
    free = {"Ixx": {"start": 0.03}, "If": {"start": 2e-4}}
    content["fit"] = {"method": "output-error", "free": free}
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_no_such_hold(chirped, capsys):
    assert main(["check", str(chirped), "--set", f"{KEY}=cubic"]) == 2
    said = capsys.readouterr().err
    assert all(w in said for w in ("x_roll.hold", "'cubic'", "auto", "zero-order", "linear"))


@pytest.mark.slow
def test_a_sweep_follows_the_holds_of_its_flights():
    """Test holds in a reduced sweep, stored trajectories and with a delay against simulate."""
    vehicle = load_vehicle(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    model, stick = models.roll_on_stand, 3e-6 * np.sin(2.0 * np.arange(60) ** 1.2)
    stick[20:40] = np.repeat([1e-6, -2e-6], 10)
    flights = [
        Flight(dt=0.02, inputs={"x_roll": stick}, outputs={}, name=hold, hold={"x_roll": hold})
        for hold in ("linear", "zero-order", "mixed")
    ]
    rms = {"rms": Reduce("rms", "roll")}
    streamed = sweep(model, vehicle, flights, grid({"Ixx": [0.02, 0.03]}), rms)
    whole = sweep(
        model, vehicle, flights, grid({"Ixx": [0.02, 0.03], "delay": [0.013]}), rms,
        trajectories=Trajectories(("roll",), 2),
    )  # fmt: skip
    for flight in flights:

        def roll(Ixx, delay, flight=flight):
            params = naming.replace(vehicle, Ixx=Ixx)
            return simulate(model, params, flight, delay=delay).outputs.roll

        runs = jax.jit(jax.vmap(roll, in_axes=(0, None)))
        at_once, late = (np.asarray(runs(jnp.asarray([0.02, 0.03]), d)) for d in (0.0, 0.013))
        rms_roll = np.sqrt(np.mean(np.square(at_once), axis=1))
        np.testing.assert_allclose(streamed["rms"].sel(flight=flight.name), rms_roll, rtol=1e-9)
        kept = whole["trajectory_roll"].sel(flight=flight.name).values.reshape(2, -1)
        np.testing.assert_allclose(kept, late[:, ::2], rtol=1e-7, atol=1e-12)
