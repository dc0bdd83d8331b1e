"""Configurations of the whole helicopter: variants, corrections and refusals."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import config as configuration
from heli_jax.config import schema
from heli_jax.errors import InputError
from heli_jax.identification.problem import Free, Nuisance, Prior

ROOT = Path(__file__).parents[1]
XCELL = str(ROOT / "configs" / "vehicles" / "x-cell-60.yaml")


@pytest.fixture
def load(tmp_path):
    """Return load(key=value, ...), the experiment of an X-Cell configuration with these keys."""

    def load(*overrides, **content):
        path = tmp_path / "xcell.yaml"
        path.write_text(yaml.safe_dump({"model": "helicopter", "vehicle": XCELL, **content}))
        return configuration.load(path, overrides)

    return load


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("helicopter", "helicopter"),
        ("helicopter-consistent", "helicopter-consistent"),
        ("helicopter-paper", "helicopter-paper"),
    ],
)
def test_the_helicopter_by_name(load, name, model):
    experiment = load(model=name)
    assert experiment.model.name == model
    assert load(model=name).model is experiment.model
    assert "beta_roll" in experiment.model.State._fields


def test_a_slow_log_gets_more_steps_a_sample(load, tmp_path):
    """Test steps of at most 5 ms, as in `simulate`."""
    rng = np.random.default_rng(0)
    log = {"t": 0.05 * np.arange(60), "u": rng.standard_normal(60), "y": rng.standard_normal(60)}
    text = "\n".join(",".join(f"{v:.6f}" for v in row) for row in zip(*log.values(), strict=True))
    (tmp_path / "log.csv").write_text(f"t,u,y\n{text}\n")
    signals = {
        "time": {"signal": "t"},
        "inputs": {"x_roll": {"signal": "u", "unit": "mm"}},
        "outputs": {"roll": {"signal": "y", "unit": "rad"}},
    }
    experiment = load(
        model="roll",
        flights=[{"log": "log.csv", "signals": signals}],
        fit={"free": {"Ixx": {"start": 0.2}}},
    )
    assert configuration.problem(experiment).substeps == 10


def test_corrections_switch_on_and_off(load):
    some = load(model="helicopter-paper", corrections={"tail": True, "drag": False})
    assert some.model.name == "helicopter-paper+tail"
    assert load("corrections.drag=false").model.name == "helicopter-drag"
    again = load(model="helicopter-paper", corrections={"drag": False, "tail": True})
    assert again.model is some.model
    assert configuration.resolved(some)["corrections"] == {"tail": True, "drag": False}


def test_a_baseline_that_is_switched_off_stays_off(load):
    # Without the key it would be on again.
    assert configuration.resolved(load(rls=None))["rls"] is None
    assert "rls" in configuration.resolved(load())


@pytest.mark.parametrize(
    ("content", "place"),
    [
        ({"model": "helicoptr"}, "model"),
        ({"model": 3}, "model"),
        ({"corrections": {"tial": True}}, "corrections"),
        ({"corrections": {"tail": 2}}, "corrections.tail"),
        ({"model": "roll", "corrections": {"tail": True}}, "corrections"),
        ({"model": "roll", "corrections": {}}, "corrections"),
        ({"corection": {}}, "corection"),
        ({"fit": {"free": {}, "instrument": []}}, "fit.instrument"),
        ({"fit": {"free": {}, "nuisance": {"input_offset": "yes"}}}, "fit.nuisance.input_offset"),
        ({"simulate": {"ground": 0.0}}, "simulate.ground"),
        ({"simulate": {"start": {"clmb": 1}}}, "simulate.start.clmb"),
        ({"simulate": {"start": 3}}, "simulate.start"),
        ({"simulate": {"wind": [1, 2]}}, "simulate.wind[2]"),
        ({"simulate": {"wind": [1, 2, float("nan")]}}, "simulate.wind[2]"),
        ({"simulate": {"hold_attitude": "often"}}, "simulate.hold_attitude"),
    ],
)
def test_what_is_wrong_is_refused_with_its_place(load, content, place):
    if "simulate" in content:
        content = {"simulate": {"duration": 2, "rate": 50, **content["simulate"]}}
    with pytest.raises(InputError, match=rf"xcell\.yaml: {re.escape(place)}:"):
        load(**content)


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.stem)
def test_shipped_configurations(path):
    experiment = configuration.load(path)
    config = experiment.config
    assert config.control is not None or config.simulate is not None
    for i, flight in enumerate(config.flights):
        where = f"{path}: flights[{i}].signals"
        configuration.signals(experiment.model, "inputs", flight.signals.inputs, where)
        configuration.signals(experiment.model, "outputs", flight.signals.outputs, where)
        assert config.simulate is not None
        assert set(config.simulate.noise) <= set(flight.signals.outputs)
    for name, free in config.fit.free.items() if config.fit else ():
        low, high = free.lower or 0.0, free.upper or float("inf")
        assert low < free.start < high
        # A fit that starts at the truth could not fail.
        assert free.start != float(getattr(experiment.vehicle.params, name))


@pytest.mark.parametrize(
    ("section", "record"),
    [
        (schema.FreeConfig, Free),
        (schema.PriorConfig, Prior),
        (schema.NuisanceConfig, Nuisance),
    ],
)
def test_sections_have_the_fields_of_their_records(section, record):
    defaults = {n: f.default for n, f in section.model_fields.items() if not f.is_required()}
    assert tuple(section.model_fields) == record._fields
    assert defaults == record._field_defaults


@pytest.mark.parametrize("key", ["fit.starts", "fit.free.Ixx.start", "flights.0.rate"])
def test_true_is_no_number(key):
    # YAML writes it without quotes, and Python computes with it as with 1.
    with pytest.raises(InputError, match="got True"):
        configuration.load(ROOT / "configs" / "bench-roll.yaml", {key: True})


@pytest.mark.parametrize(
    ("key", "value", "got"),
    [
        ("fit.starts", "3", "'3'"),
        ("fit.free.Ixx.start", "1e-4", "'1e-4'"),
        ("flights.0.rate", "100", "'100'"),
        ("frequency.band", [0.1, "6"], "'6'"),
    ],
)
def test_text_is_no_number(key, value, got):
    # The JSON schema refuses it too, so an editor shows the same error as a fit.
    with pytest.raises(InputError, match=f"got {got}"):
        configuration.load(ROOT / "configs" / "bench-roll.yaml", {key: value})
