"""What the command line says of the time between samples: simulate, check, fit, a sweep."""

import json
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
    """The demo's bench with a chirp, and its log."""
    folder = tmp_path_factory.mktemp("chirp")
    content = yaml.safe_load((ROOT / "configs" / "bench-roll.yaml").read_text())
    content["vehicle"] = str(ROOT / "configs" / "vehicles" / "bench-30.yaml")
    content["flights"][0]["log"] = "bench.csv"
    del content["disturbance"]
    content["rls"] = None
    content["simulate"]["duration"] = 20  # 1000 samples, as elsewhere
    content["simulate"]["inputs"]["x_roll"] |= {"kind": "chirp", "amplitude": 10.0}
    free = {"Ixx": {"start": 0.03}, "If": {"start": 2e-4}}
    content["fit"] = {"method": "output-error", "free": free}
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.mark.slow
def test_simulate_check_and_fit_say_what_was_taken_and_why(chirped, capsys, tmp_path):
    assert main(["simulate", str(chirped), "--out", str(chirped.parent / "bench.csv")]) == 0
    said = capsys.readouterr().err
    assert "x_roll: held between samples here" in said
    assert "hold: zero-order" in said
    assert main(["check", str(chirped)]) == 0
    out, err = capsys.readouterr()
    assert "x_roll is taken as linear between samples, since it moves at " in err
    assert "! Between samples x_roll is taken as linear (it moves at" in out
    assert main(["check", str(chirped), "--set", f"{KEY}=zero-order"]) == 0
    assert "x_roll is taken as zero-order (as stated)" in capsys.readouterr().out
    held = ["--set", f"{KEY}=zero-order", "--out", str(tmp_path / "a")]
    assert main(["fit", str(chirped), *held]) == 0
    found = json.loads((tmp_path / "a" / "fit.json").read_text())
    assert found["inputs"] == [{"x_roll": {"hold": "zero-order", "reason": "as stated"}}]
    # The log was held: so its truth is within the intervals, as it is not with straight lines.
    for name, truth in (("Ixx", 0.024), ("If", 1.7e-4)):
        assert found["parameters"][name]["lower95"] < truth < found["parameters"][name]["upper95"]
    # Nothing stated: the log looks like a stick sampled on its way, and the record says otherwise.
    assert main(["fit", str(chirped), "--out", str(tmp_path / "b")]) == 0
    found = json.loads((tmp_path / "b" / "fit.json").read_text())
    assert found["inputs"][0]["x_roll"]["hold"] == "zero-order"
    assert found["inputs"][0]["x_roll"]["reason"].startswith("explains the record better")
    assert "timing.likelier-hold" in {f["code"] for f in found["findings"]}
    for name, truth in (("Ixx", 0.024), ("If", 1.7e-4)):
        assert found["parameters"][name]["lower95"] < truth < found["parameters"][name]["upper95"]
    report = (tmp_path / "b" / "report.html").read_text()
    assert "x_roll between samples" in report
    assert "zero-order (explains the record" in report


def test_no_such_hold(chirped, capsys):
    assert main(["check", str(chirped), "--set", f"{KEY}=cubic"]) == 2
    said = capsys.readouterr().err
    assert all(w in said for w in ("x_roll.hold", "'cubic'", "auto", "zero-order", "linear"))


@pytest.mark.slow
def test_a_sweep_follows_the_holds_of_its_flights():
    """Reduced while it goes on, kept whole, and delayed: each as simulate has it."""
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
