"""The page of a manoeuvre: self-contained, escaped, with the vehicle in the right attitude."""

import base64
import json
import re
from types import SimpleNamespace

import diffrax as dfx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from heli_jax import models
from heli_jax.dynamics.helicopter import HelicopterInputs, HelicopterOutputs
from heli_jax.report import figures
from heli_jax.report import view as page_view
from heli_jax.report.charts import Numbers
from heli_jax.report.view import write_view
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.vehicle import load_vehicle
from tests.report.conftest import SCRIPT
from tests.report.test_html import Links, words

HELICOPTER = models.by_name("helicopter-consistent")


def flown(n=300, dt=0.02, **states):
    """Return a run of n samples with these states, zero elsewhere."""
    zero = np.zeros(n)
    times = dt * np.arange(n)
    out = times > times[n // 2]
    x = HELICOPTER.State(
        **{f: np.broadcast_to(states.get(f, zero), n) for f in HELICOPTER.State._fields}
    )
    inputs = HelicopterInputs(1e-3 * np.sin(times), zero, zero - 0.5, zero + 0.5)
    outputs = HelicopterOutputs(
        x.phi, x.theta, x.psi, x.dphi, x.dtheta, x.dpsi, x.x, x.y, x.z, x.dx, x.dy, x.dz, x.Omega
    )
    ok = dfx.RESULTS.successful
    outside = {"fast flight": out, "slow rotor": zero > 0}
    return Trajectory(times, x, outputs, inputs, ok, np.asarray(True), outside, np.inf, -1)


@pytest.fixture(scope="module")
def xcell(vehicles_folder):
    return load_vehicle(vehicles_folder / "x-cell-60.yaml")


@pytest.mark.parametrize(
    ("angle", "part", "expected"),
    [
        ("theta", [1, 0, 0], [np.cos(0.3), 0, np.sin(0.3)]),  # nose up
        ("phi", [0, 1, 0], [0, -np.cos(0.3), -np.sin(0.3)]),  # right side down
        ("psi", [1, 0, 0], [np.cos(0.3), -np.sin(0.3), 0]),  # nose right; the figure's y is left
    ],
)
def test_the_shape_turns_as_the_machine_does(angle, part, expected):
    states = SimpleNamespace(**{"phi": 0.0, "theta": 0.0, "psi": 0.0, angle: 0.3})
    shape = page_view.placed(np.array([part], float), page_view.attitude(states), np.zeros(3))
    np.testing.assert_allclose(shape[0], expected, atol=1e-12)


def test_the_mast_points_where_the_thrust_does(xcell):
    """Test all three angles at once, against the model's accelerations."""
    at = {"phi": 0.4, "theta": -0.3, "psi": 1.1, "Omega": float(xcell.Omega)}
    x = HELICOPTER.State(**{f: at.get(f, 0.0) for f in HELICOPTER.State._fields})
    rates = HELICOPTER.vector_field(xcell, x, HelicopterInputs(0.0, 0.0, 0.0, 0.5))
    pull = np.array([rates.dx, rates.dy, rates.dz + xcell.g])
    up = page_view.placed(
        np.array([[0.0, 0.0, -1.0]]), page_view.attitude(SimpleNamespace(**at)), np.zeros(3)
    )[0]
    np.testing.assert_allclose(up * [1, -1, 1], pull / np.linalg.norm(pull), atol=1e-9)


def decoded(content, number):
    """Return an array of a page, decoded by hand."""
    a = content["arrays"][number]
    if "n" in a:
        return a["from"] + a["step"] * np.arange(a["n"])
    if "f" in a:
        return np.frombuffer(base64.b64decode(a["f"]), "<f4").astype(float)
    parts = np.frombuffer(base64.b64decode(a["q"]), "<u2")
    return np.where(parts == 65535, np.nan, a["low"] + a["step"] * parts)


def test_the_scene_follows_the_run(xcell):
    t = 0.02 * np.arange(1000)
    run = flown(1000, x=2.0 * t, y=0.5 * t, z=0.1 * t, phi=0.2 * np.sin(t), psi=0.6 * t)
    numbers = Numbers()
    made = page_view.scene(run, xcell, numbers)
    content = numbers.content()
    path = np.array([decoded(content, n) for n in made["path"]])
    np.testing.assert_allclose(path, [2.0 * t, -0.5 * t, 0.1 * t], atol=1e-3)
    turns = np.array([decoded(content, n) for n in made["turns"]]).T
    # Interpolated between two: their sign must not change.
    assert np.all(np.sum(turns[1:] * turns[:-1], axis=1) > 0.9)
    expected = Rotation.from_euler("ZYX", np.stack([0.6 * t, 0 * t, 0.2 * np.sin(t)], axis=1))
    assert np.max((Rotation.from_quat(turns) * expected.inv()).magnitude()) < 2e-4
    disk = np.array(made["parts"][1]["points"])
    radius = np.linalg.norm(disk[1:] - disk[0], axis=1)
    assert radius == pytest.approx(page_view.size_of(run, float(xcell.R)) * float(xcell.R), 1e-3)
    for (low, high), ticks in zip(np.transpose(made["bounds"]), made["ticks"], strict=True):
        assert 3 <= len(ticks) <= 8
        assert low <= ticks[0] < ticks[-1] <= high


def test_figures_show_everything_and_shade_what_was_left():
    t = 0.02 * np.arange(300)
    run = flown(z=np.sin(t), Omega=150 + t)
    for chart, labels in (
        (figures.motion(run, HELICOPTER), ["[rad]", "[rad/s]", "[m]", "[m/s]"]),
        (figures.sticks(run, HELICOPTER), ["[mm]", "[–]", "rotor_speed [rad/s]"]),
    ):
        assert len(chart.panels) == len(labels)
        for panel, text in zip(chart.panels, labels, strict=True):
            assert text in panel.label
            assert panel.shades == (pytest.approx((t[151], t[-1])),)
    drawn = [s.label for p in chart.panels for s in p.series]
    assert drawn == ["x_roll", "x_pitch", "x_yaw", "x_throttle", "rotor_speed"]
    assert [s.kind for s in chart.panels[0].series] == ["step"] * len(chart.panels[0].series)
    assert np.max(chart.panels[0].series[0].y) == pytest.approx(1.0, rel=1e-3)


def test_page_holds_everything_itself_and_escapes(tmp_path, xcell):
    run = flown(z=0.1 * np.arange(300))
    path = tmp_path / "view.html"
    note = f"the run leaves {SCRIPT}"
    write_view(path, {SCRIPT: run, "two": run}, HELICOPTER, xcell, f"x {SCRIPT}", [note])
    text = path.read_text(encoding="utf-8")
    links = Links(text)
    assert links.addresses == []
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"']?https?:", text)
    assert "<script>alert(1)</script>" not in text
    assert f"<title>x {SCRIPT.replace('<', '&lt;').replace('>', '&gt;')}</title>" in text
    assert text.count('class="flight" data-scene=') == 2
    assert len(text) < 500_000


def test_a_run_that_diverges_is_drawn_as_far_as_it_goes(tmp_path, xcell):
    z = np.where(np.arange(300) < 100, 0.1 * np.arange(300), np.nan)
    path = tmp_path / "view.html"
    runs = {"never": flown(z=np.full(300, np.nan)), "lost": flown(z=z)}
    write_view(path, runs, HELICOPTER, xcell, "lost")
    text = path.read_text(encoding="utf-8")
    [content] = re.findall(r'id="numbers">(.*?)</script>', text)
    [made] = json.loads(content)["scenes"]
    assert decoded(json.loads(content), made["path"][2]).size == 100


def test_a_part_of_the_helicopter_has_figures_only(tmp_path, bench30):
    t = 0.02 * np.arange(50)
    model = models.roll
    states = model.State(**dict.fromkeys(model.State._fields, np.sin(t)))
    inputs = model.Inputs(x_roll=3e-6 * np.cos(t))
    outputs = jax.vmap(lambda x, u: model.output(bench30, x, u))(states, inputs)
    ok = dfx.RESULTS.successful
    run = Trajectory(t, states, outputs, inputs, ok, np.asarray(True), {}, np.inf, -1)
    path = tmp_path / "view.html"
    write_view(path, {"roll": run}, model, bench30, "roll")
    text = path.read_text(encoding="utf-8")
    assert "canvas" not in Links(text).tags
    assert text.count("<figure data-chart=") == 2
    assert "needs the whole helicopter" in words(text)
    [panel] = figures.sticks(run, model).panels
    assert panel.label == "x_roll [mm]"


def test_what_is_nearly_constant_is_not_blown_up_to_its_panel():
    t = 0.02 * np.arange(300)
    run = flown(phi=1e-9 * np.sin(t), Omega=150 + 0.01 * np.sin(t), z=np.sin(t))
    attitude, _, position, _ = figures.motion(run, HELICOPTER).panels
    assert np.ptp(attitude.limits) == pytest.approx(1.1 * 0.005)
    # Axes of moving quantities have a margin of 5 %.
    assert np.ptp(position.limits) == pytest.approx(1.1 * np.ptp(np.sin(t)), rel=1e-2)
    rotor = figures.sticks(run, HELICOPTER).panels[-1]
    assert np.ptp(rotor.limits) == pytest.approx(1.1 * 0.05 * 150.01, rel=1e-3)
    assert np.mean(rotor.limits) == pytest.approx(150.0, abs=0.02)
