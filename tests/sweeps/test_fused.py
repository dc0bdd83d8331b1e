"""Fused runs against XLA, sample by sample."""

import dataclasses
import re

import numpy as np
import pytest

from heli_jax import Flight, models, naming, sweep
from heli_jax.sweeps import Range, Reduce, paired, sobol

STAND = models.roll_on_stand
BOTH = {"rms": Reduce("rms", "roll"), "peak": Reduce("peak", "roll"), "mode": Reduce("modes")}


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(3)
    u = 3e-6 * np.repeat(rng.uniform(-1, 1, 12), 10)
    y = 1e-2 * rng.standard_normal(u.size)
    y[40:60] = np.nan
    return Flight(dt=0.02, inputs={"x_roll": u}, outputs={"roll": y})


def agree(rtol, model, vehicle, flight, design, reduce, **options):
    by_xla = sweep(model, vehicle, flight, design, reduce, backend="xla", **options)
    fused = sweep(model, vehicle, flight, design, reduce, backend="fused", **options)
    assert fused.attrs["split"]["backend"] == "fused"
    assert by_xla.attrs["split"]["backend"] == "xla"
    np.testing.assert_array_equal(fused["status"], by_xla["status"])
    for name in by_xla.data_vars:
        a, b = by_xla[name].to_numpy(), fused[name].to_numpy()
        np.testing.assert_allclose(
            b, a, rtol=rtol, atol=rtol * max(np.nanmax(np.abs(a), initial=0.0), 1e-6)
        )
    return fused


@pytest.mark.parametrize(
    ("solver", "hold"),
    [
        ("exact", "linear"),
        ("rk4", "zero-order"),
    ],
)
def test_the_stand(bench30, record, solver, hold):
    flight = dataclasses.replace(record, hold={"x_roll": hold})
    design = sobol({"Ixx": Range(0.02, 0.05, "log"), "gain.x_roll": Range(0.5, 2.0)}, 20)
    reduce = BOTH | {n: Reduce(n, "roll") for n in ("rmse", "vaf", "tic", "final", "max")}
    agree(1e-13, STAND, bench30, flight, design, reduce, solver=solver)


def test_single_precision(bench30, record):
    design = paired({"If": np.geomspace(2e-4, 6e-4, 10)})
    reduce = {"rms": Reduce("rms", "roll")}
    found = agree(1e-4, STAND, bench30, record, design, reduce, precision="float32")
    assert found["rms"].dtype == np.float32


def test_what_became_of_an_element_is_the_same(bench30, record):
    # A spring that pushes it out of range, a NaN parameter, an impossible parameter.
    design = paired({"kappa": [0.0, -1e5, 0.0, 0.0], "Ixx": [0.03, 0.03, np.nan, -0.03]})
    found = agree(1e-11, STAND, bench30, record, design, {"rms": Reduce("rms", "roll")})
    assert found["status"].to_numpy().tolist() == [0, 2, 1, 2]


def test_a_sweep_that_cannot_be_fused(bench30, record, tmp_path):
    design, reduce = paired({"Ixx": [0.03, 0.04], "delay": [0.0, 0.01]}), {"m": BOTH["rms"]}
    found = sweep(STAND, bench30, record, design, reduce)
    assert found.attrs["split"]["backend"] == "xla"
    with pytest.raises(ValueError, match=r"backend: this sweep cannot be fused: its runs are kept"):
        sweep(STAND, bench30, record, design, reduce, backend="fused")
    design = paired({"Ixx": [0.03, 0.04]})
    with pytest.raises(ValueError, match="the solver Tsit5 cannot be translated"):
        sweep(STAND, bench30, record, design, reduce, backend="fused", solver="Tsit5")
    with pytest.raises(ValueError, match="backend: expected one of auto, xla, fused, got 'gpu'"):
        sweep(STAND, bench30, record, design, reduce, backend="gpu")


def test_an_operation_without_a_translation_is_said(bench30, record, capsys):
    import jax

    from heli_jax.sweeps.run import Options, run_sweep
    from heli_jax.sweeps.spec import job

    def field(params, state, inputs):
        slope = STAND.vector_field(params, state, inputs)
        odd = jax.scipy.special.erfinv(0.1 * slope.phi)
        return naming.replace(slope, phi=odd)

    model = dataclasses.replace(STAND, vector_field=field, linear=False)
    said = []
    wanted = job(model, bench30, record, paired({"Ixx": [0.03, 0.04]}), {"m": BOTH["rms"]})
    found = run_sweep(wanted, None, Options(say=said.append))
    assert found.attrs["split"]["backend"] == "xla"
    said = next(s for s in said if "cannot be translated" in s)
    assert re.search(r"the operation erf_inv \(at test_fused.py:\d+\)", said)


def test_a_translation_that_fails_is_no_sweep_that_fails(bench30, record, monkeypatch):
    from heli_jax.fused.operations import OPERATIONS
    from heli_jax.sweeps.run import Options, run_sweep
    from heli_jax.sweeps.spec import job

    right = OPERATIONS["mul"]

    def wrong(code, *values, **others):
        # An index into a record stays unchanged.
        if values[0].dtype.kind != "f":
            return right(code, *values, **others)
        return code.made("fmul contract i32 %nowhere, 1", values[0].dtype, False)

    monkeypatch.setitem(OPERATIONS, "sub", wrong)
    monkeypatch.setitem(OPERATIONS, "mul", wrong)
    said = []
    wanted = job(STAND, bench30, record, paired({"Ixx": [0.031, 0.042]}), {"own": BOTH["rms"]})
    found = run_sweep(wanted, None, Options(say=said.append, lanes=1))
    assert found.attrs["split"]["backend"] == "xla"
    assert any("whose translation failed (RuntimeError: LLVM IR parsing error" in s for s in said)
    with pytest.raises(ValueError, match=r"backend: this sweep cannot be fused: .*LLVM IR"):
        run_sweep(wanted, None, Options(backend="fused", lanes=1))
