"""Files of linear models: the resulting models, units and refusals."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from heli_jax import naming
from heli_jax.analysis.linear import eigenmodes, linearize
from heli_jax.dynamics.disturbance import disturbable, with_disturbance
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.simulation.simulate import simulate

SMALL = {
    "name": "small",
    "states": {"u": {"unit": "ft/s", "meaning": "speed"}, "theta": "deg"},
    "inputs": {"lon": "%"},
    "outputs": {"theta": "deg", "climb": "ft/s"},
    "parameters": {
        "g": {"value": 32.0, "unit": "ft/s^2", "source": "a book", "positive": True},
        "Xu": {"value": -0.1, "unit": "1/s"},
        "tau": {"value": 0.5, "unit": "s", "positive": True},
        "k": {"value": 3.0, "unit": "rad"},
    },
    "A": {"u": {"u": "Xu", "theta": "-g"}, "theta": {"u": 0.25, "theta": "-1/tau"}},
    "B": {"theta": {"lon": "k/tau"}},
    "C": {"climb": {"u": 2, "theta": "-g*tau"}},
    "D": {"climb": {"lon": -4}},
}
FT, DEG = 0.3048, np.pi / 180


@pytest.fixture
def read(tmp_path):
    """Return read(change), the model of SMALL after change(content)."""

    def read(change=lambda content: None):
        content = copy.deepcopy(SMALL)
        change(content)
        path = tmp_path / "small.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
        return linear_model("small.yaml", tmp_path)

    return read


def matrices(found, vehicle=None):
    params = (found.vehicle() if vehicle is None else vehicle).params
    return [np.asarray(M) for M in linearize(found.model, params).matrices]


def test_everything_is_in_si(read):
    """Test matrices by hand: a number has the file's units, a parameter its own."""
    A, B, C, D = matrices(read())
    np.testing.assert_allclose(A, [[-0.1, -32 * FT], [0.25 * DEG / FT, -2.0]], rtol=1e-14)
    np.testing.assert_allclose(B, [[0.0], [6.0]], rtol=1e-14)
    np.testing.assert_allclose(C, [[0.0, 1.0], [2.0, -16 * FT]], rtol=1e-14)
    np.testing.assert_allclose(D, [[0.0], [-4 * FT / 0.01]], rtol=1e-14)


def test_signals_and_constants_have_si_units_and_their_words(read):
    found = read()
    assert naming.unit(found.model.State, "u") == "m/s"
    assert naming.meaning(found.model.State, "u") == "speed"
    assert naming.unit(found.model.Inputs, "lon") == "1"
    assert naming.unit(found.model.Outputs, "theta") == "rad"
    g = found.vehicle().constants["g"]
    assert (g.value, g.unit, g.source) == (32 * FT, "m/s^2", "a book")
    assert found.model.linear
    assert found.model.positive == ("g", "tau")
    np.testing.assert_allclose(found.model.Params().k, 3.0)


def test_the_same_file_read_twice_is_the_same_model(read, tmp_path):
    once = read()
    assert read().model is once.model
    (tmp_path / "other.yaml").write_text((tmp_path / "small.yaml").read_text())
    assert linear_model(tmp_path / "other.yaml").model is once.model
    assert read(lambda c: c["A"]["u"].update(u=-0.2)).model is not once.model


def test_values_are_replaced_by_name(read):
    found = read()
    vehicle = found.vehicle({"g": {"value": 9.81, "unit": "m/s^2"}, "tau": 0.25}, "mine.yaml")
    A, *_ = matrices(found, vehicle)
    np.testing.assert_allclose(A[0], [-0.1, -9.81], rtol=1e-14)
    np.testing.assert_allclose(A[1, 1], -4.0)
    assert vehicle.constants["Xu"].value == -0.1
    for given, words in (
        ({"tau": -1}, "mine.yaml: tau: expected a value above zero .* got -1"),
        ({"taw": 1}, "mine.yaml: unknown constant 'taw'; did you mean 'tau'"),
    ):
        with pytest.raises(InputError, match=words):
            found.vehicle(given, "mine.yaml")


def test_masses_stand_on_the_left(read):
    """Test E x' = A x + B u with units in E, against NumPy's solution."""

    def change(content):
        content["parameters"]["m"] = {"value": 2.0, "unit": "lb"}
        content["parameters"]["s"] = {"value": 0.3, "unit": "kg m/s"}
        content["parameters"]["Fu"] = {"value": -0.7, "unit": "N s/m"}
        content["A"]["u"] = {"u": "Fu", "theta": "-m*g"}
        content["E"] = {"u": {"u": "m", "theta": "s"}, "theta": {"theta": 1, "u": 0.125}}

    A, B, *_ = matrices(read(change))
    m = 2 * 0.45359237
    E = np.array([[m, 0.3], [0.125 * DEG / FT, 1.0]])
    A0 = np.array([[-0.7, -m * 32 * FT], [0.25 * DEG / FT, -2.0]])
    np.testing.assert_allclose(A, np.linalg.solve(E, A0), rtol=1e-13)
    np.testing.assert_allclose(B, np.linalg.solve(E, [[0.0], [6.0]]), rtol=1e-13)


def test_a_delayed_input_acts_late(read):
    """Test a delay of whole samples, which equals a shifted record."""
    found = read(lambda c: c.update(delays={"lon": "tau"}))
    assert found.model.delays == (("lon", "tau"),)
    stick = np.random.default_rng(0).standard_normal(40)
    params = naming.replace(found.vehicle().params, tau=0.3)
    late = simulate(found.model, params, found.model.Inputs(lon=stick), dt=0.1).states
    shifted = np.concatenate([np.full(3, stick[0]), stick[:-3]])
    at_once = read()
    plain = simulate(at_once.model, params, at_once.model.Inputs(lon=shifted), dt=0.1).states
    for name in naming.names(found.model.State):
        np.testing.assert_allclose(getattr(late, name), getattr(plain, name), rtol=1e-9, atol=1e-12)


def test_a_negative_delay_acts_early_unless_it_is_positive(read):
    """Test both the file and a vehicle."""

    def early(**quantity):
        def change(content):
            content["parameters"]["lead"] = {"value": -0.2, "unit": "s", **quantity}
            content["delays"] = {"lon": "lead"}

        return change

    found = read(early())
    params, stick = found.vehicle().params, np.random.default_rng(0).standard_normal(40)
    assert float(params.lead) == -0.2
    assert float(found.vehicle({"lead": -0.3}).params.lead) == -0.3
    run = simulate(found.model, params, found.model.Inputs(lon=stick), dt=0.1).states
    shifted = found.model.Inputs(lon=np.concatenate([stick[2:], np.full(2, stick[-1])]))
    plain = dataclasses.replace(found.model, delays=())
    at_once = simulate(plain, params, shifted, dt=0.1).states
    for name in naming.names(found.model.State):
        np.testing.assert_allclose(getattr(run, name), getattr(at_once, name), atol=1e-9)
    with pytest.raises(InputError, match="lead: expected a value above zero"):
        read(early(positive=True))


def test_axes_go_by_the_names_of_states_or_are_stated(read):
    assert disturbable(linear_model("hybrid").model) == ["roll", "pitch", "yaw", "heave"]
    assert disturbable(read().model) == []
    stated = read(lambda c: c.update(axes={"surge": {"rate": "u", "stick": "lon"}})).model
    disturbed = with_disturbance(stated, "surge")
    assert naming.unit(disturbed.Params, "sigma_w") == "m/s^2"
    assert disturbed.positive == stated.positive


def put(*keys):
    """Return a change that puts the last of `keys` under the others."""

    def change(content):
        *above, last, value = keys
        for key in above:
            content = content.setdefault(key, {})
        content[last] = value

    return change


def drop(*keys):
    def change(content):
        *above, last = keys
        for key in above:
            content = content[key]
        del content[last]

    return change


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (put("paramters", {}), "paramters"),
        (drop("A"), "A"),
        (put("name", 3), "name"),
        (put("states", {}), "states"),
        (put("states", ["u"]), "states"),
        (put("states", "u", {"unit": "ft/s", "menaing": "x"}), "states.u.menaing"),
        (put("states", "u", None), "states.u"),
        (put("states", "u", "furlong"), "states.u.unit"),
        (put("states", "1u", "m"), "states"),
        (put("states", "class", "m"), "states"),
        (put("states", "λ", "m"), "states"),
        (put("parameters", "sigma_w", {}), "parameters.sigma_w"),
        (put("parameters", "u", {"value": 1, "unit": "1"}), "parameters.u"),
        (put("parameters", "k", 3.0), "parameters.k"),
        (put("parameters", "k", "unit", None), "parameters.k.unit"),
        (put("parameters", "k", "value", "3"), "parameters.k.value"),
        (put("parameters", "k", "value", float("nan")), "parameters.k.value"),
        (put("parameters", "k", "positive", "yes"), "parameters.k.positive"),
        (put("parameters", "tau", "value", -1), "tau"),
        (put("parameters", "g", "value", 0), "g"),
        (put("A", "w", {}), "A.w"),
        (put("A", "u", "thete", 1), "A.u.thete"),
        (put("B", "u", {"lan": 1}), "B.u.lan"),
        (put("C", "clim", {}), "C.clim"),
        (put("A", "u", "u", "Xv"), "A.u.u"),
        (put("A", "u", "u", "1/0"), "A.u.u"),
        (put("A", "u", "u", "Xu/(k - k)"), "A.u.u"),
        (put("A", "u", "u", True), "A.u.u"),
        (put("A", "u", "u", ["Xu"]), "A.u.u"),
        (put("A", "u", "u", "tau"), "A.u.u"),
        (put("A", "u", "u", "Xu + 2"), "A.u.u"),
        (put("A", "u", "Xu"), "A.u"),
        (lambda c: (drop("A", "theta")(c), drop("B")(c)), "A.theta"),
        (lambda c: (drop("C")(c), drop("D")(c)), "outputs.climb"),
        (put("outputs", "theta", "m"), "outputs.theta.unit"),
        (put("E", {"u": {"theta": 1}}), "E"),
        (put("E", {"u": {"u": "g"}}), "A.u.u"),
        (lambda c: (put("E", {"u": {"u": "g"}})(c), put("A", "u", {"u": 1})(c)), "A.u.u"),
        (put("delays", {"lan": "tau"}), "delays.lan"),
        (put("delays", {"lon": "taw"}), "delays.lon"),
        (put("delays", {"lon": 0.1}), "delays.lon"),
        (put("delays", {"lon": "k"}), "delays.lon"),
        (put("axes", {"roll": {}}), "axes.roll.rate"),
        (put("axes", {"roll": {"rate": "p"}}), "axes.roll.rate"),
        (put("axes", {"roll": {"rate": "u", "stick": "u"}}), "axes.roll.stick"),
        (put("axes", {"roll": {"rate": "u", "flybar": "u"}}), "axes.roll.flybar"),
    ],
)
def test_what_is_wrong_ends_in_a_sentence_with_its_place(read, tmp_path, change, place):
    with pytest.raises(InputError) as e:
        read(change)
    said = str(e.value)
    assert said.startswith(f"{tmp_path / 'small.yaml'}: {place}")
    assert "\n" not in said


def test_what_is_no_file_ends_in_a_sentence(tmp_path):
    (tmp_path / "cycle.yaml").write_text("states: &s {u: *s}\n")
    (tmp_path / "none.yaml").write_text("")
    for name in ("hybird", "roll.yaml", "cycle.yaml", "none.yaml"):
        with pytest.raises(InputError, match=name):
            linear_model(name, tmp_path)


def test_the_example_of_the_page_reads(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "linear-models.md").read_text(encoding="utf-8")
    example = next(t for t in page.split("```yaml\n")[1:] if t.startswith("name:"))
    (tmp_path / "my-roll.yaml").write_text(example.split("```")[0])
    found = linear_model("my-roll.yaml", tmp_path)
    A, B, C, _ = matrices(found)
    expected = [[0, 1, 0], [0, 0, 166.1], [0, -1, -1 / 0.046]]
    np.testing.assert_allclose(A, expected, rtol=1e-14)
    np.testing.assert_allclose(B, [[0], [0], [0.14 / 0.046]], rtol=1e-14)
    np.testing.assert_allclose(C, [[1, 0, 0], [0, 0, 9.81]], rtol=1e-14)


def test_the_modes_of_the_r50_have_the_fields_names():
    published = linear_model("r50-hover")
    found = {m.name: m.eigenvalue for m in eigenmodes(published.model, published.vehicle().params)}
    # The hover oscillation and the regressing modes of rotor and bar of CMU-RI-TR-00-03.
    assert found["phugoid with roll"] == pytest.approx(0.3061 + 0.0937j, abs=1e-4)
    assert {"roll flapping with flybar roll", "pitch flapping with flybar pitch"} <= set(found)
