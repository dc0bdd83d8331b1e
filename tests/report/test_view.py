"""The page of a manoeuvre: self-contained, escaped."""

import json
import re

import diffrax as dfx
import jax
import numpy as np
import pytest

from heli_jax import models
from heli_jax.dynamics.helicopter import HelicopterInputs, HelicopterOutputs
from heli_jax.report import figures
from heli_jax.report.view import write_view
from heli_jax.simulation.trajectory import Trajectory
from tests.report.conftest import SCRIPT
from tests.report.test_html import Links

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


def test_page_holds_everything_itself_and_escapes(tmp_path):
    run = flown(z=0.1 * np.arange(300))
    path = tmp_path / "view.html"
    note = f"the run leaves {SCRIPT}"
    write_view(path, {SCRIPT: run, "two": run}, HELICOPTER, f"x {SCRIPT}", [note])
    text = path.read_text(encoding="utf-8")
    links = Links(text)
    assert links.addresses == []
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"']?https?:", text)
    assert "<script>alert(1)</script>" not in text
    assert f"<title>x {SCRIPT.replace('<', '&lt;').replace('>', '&gt;')}</title>" in text
    assert text.count("<figure data-chart=") == 4
    assert len(text) < 500_000


def test_a_run_that_diverges_is_drawn_as_far_as_it_goes(tmp_path):
    z = np.where(np.arange(300) < 100, 0.1 * np.arange(300), np.nan)
    path = tmp_path / "view.html"
    runs = {"never": flown(z=np.full(300, np.nan)), "lost": flown(z=z)}
    write_view(path, runs, HELICOPTER, "lost")
    text = path.read_text(encoding="utf-8")
    [content] = re.findall(r'id="numbers">(.*?)</script>', text)
    content = json.loads(content)
    last = [chart["x_limits"][1] for chart in content["charts"]]
    assert last == pytest.approx([0.02, 0.02, 1.98, 1.98])


def test_a_part_of_the_helicopter_has_figures(tmp_path, bench30):
    t = 0.02 * np.arange(50)
    model = models.roll
    states = model.State(**dict.fromkeys(model.State._fields, np.sin(t)))
    inputs = model.Inputs(x_roll=3e-6 * np.cos(t))
    outputs = jax.vmap(lambda x, u: model.output(bench30, x, u))(states, inputs)
    ok = dfx.RESULTS.successful
    run = Trajectory(t, states, outputs, inputs, ok, np.asarray(True), {}, np.inf, -1)
    path = tmp_path / "view.html"
    write_view(path, {"roll": run}, model, "roll")
    text = path.read_text(encoding="utf-8")
    assert text.count("<figure data-chart=") == 2
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
