"""Rows and Jacobians from programs of machine code against those that JAX makes of the record."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from heli_jax import Free, Nuisance, Prior, Problem, fit, models
from heli_jax.fused.code import UnsupportedError
from heli_jax.identification.estimation import many_runs
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.filter_error import OBJECTIVE as FILTER_ERROR
from heli_jax.identification.estimation.many_runs import FusedRuns, Own, optimise_many
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.uncertainty.bootstrap import bootstrap
from heli_jax.identification.uncertainty.comparison import intervals
from heli_jax.identification.unknowns.layout import Noise, layout_of, value_of
from tests.identification.bench import BENCH, record, response, vehicle

FREE = {"Ixx": Free(0.03), "If": Free(2e-4), "a": Free(5.0, prior=Prior(5.5, 0.5))}
RUNS = 18
"""more than one vector of them, and no whole number of vectors"""


def holes(flight, share=0.2):
    outputs = {n: np.array(y) for n, y in flight.outputs.items()}
    rng = np.random.default_rng(7)
    for y in outputs.values():
        y[rng.random(y.size) < share] = np.nan
    return dataclasses.replace(flight, outputs=outputs)


def one(**how):
    return [holes(record(BENCH, seed=3, n=150, **how))]


def problem(flights, free=FREE, **how):
    return Problem(models.roll_on_stand, vehicle(BENCH), flights, free, **how)


NONE = Nuisance(False, False)


def rk4():
    nuisance = Nuisance(False, False, input_gain=True, input_offset=True)
    return problem(one(hold={"x_roll": "linear"}), nuisance=nuisance, solver="rk4", substeps=1)


def exactly():
    return problem([*one(), record(BENCH, seed=4, n=90, known={"kappa": 5.0})])


def pieces(problem, seed=0, apart=0.05):
    """Layout, numbers, noise and points near the start."""
    layout = layout_of(problem, problem.flights)
    data = data_of(problem, problem.flights)
    z = np.asarray(start_vector(layout, data, problem))
    rng = np.random.default_rng(seed)
    sd = tuple(dict.fromkeys(f.outputs, np.asarray(2e-3)) for f in data.flights)
    return layout, data, Noise(sd, np.zeros(())), z + apart * rng.standard_normal((RUNS, z.size))


def tiled(data, own, seed=1):
    """The numbers with a leading axis, of records of their own."""
    rng = np.random.default_rng(seed)

    def many(v):
        return np.broadcast_to(np.asarray(v), (RUNS, *np.shape(v)))

    def other(v):
        v = np.asarray(v)
        return v + 0.1 * np.nanstd(v) * rng.standard_normal((RUNS, *v.shape))

    made = jax.tree.map(many, data)
    each = tuple(
        f._replace(
            inputs=jax.tree.map(other, g.inputs) if own.inputs else f.inputs,
            outputs=jax.tree.map(other, g.outputs) if own.outputs else f.outputs,
        )
        for f, g in zip(made.flights, data.flights, strict=True)
    )
    return made._replace(flights=each)


def products(r, J):
    rows = np.concatenate([np.asarray(r)[:, :, None], np.asarray(J)], axis=2)
    return np.einsum("bni,bnj->bij", rows, rows)


@pytest.mark.parametrize("made", [rk4, pytest.param(exactly, marks=pytest.mark.slow)])
def test_rows_and_jacobians_are_as_jax_makes_them(made):
    own = Own(True, True)
    layout, data, noise, z = pieces(made())
    numbers = tiled(data, own)
    found = products(*FusedRuns(layout, data, noise, own)(numbers, jnp.asarray(z)))
    each = jax.vmap(lambda d, z: residual_and_jacobian(layout, d, noise, z))(numbers, z)
    expected = products(each.r, each.J)
    size = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    unit = np.where(size > 0, size, 1.0)
    np.testing.assert_allclose(
        found / unit[:, :, None] / unit[:, None, :],
        expected / unit[:, :, None] / unit[:, None, :],
        atol=1e-10,
        rtol=0,
    )


def test_a_run_that_leaves_all_numbers_is_not_a_number():
    layout, data, noise, z = pieces(rk4())
    z[3, 0] = -60.0  # Ixx of 1e-28 kg m^2
    own = Own(False, False)
    r, J = FusedRuns(layout, data, noise, own)(tiled(data, own), jnp.asarray(z))
    finite = np.isfinite(np.asarray(r)).all(axis=1) & np.isfinite(np.asarray(J)).all(axis=(1, 2))
    assert list(np.flatnonzero(~finite)) == [3]


@pytest.mark.parametrize(
    "changed", [{"shift": True}, {"windows": ((3, 50),)}, {"objective": FILTER_ERROR}]
)
def test_what_has_no_such_program(changed):
    layout, data, noise, _ = pieces(problem(one()))
    layout = dataclasses.replace(layout, **changed)
    with pytest.raises(UnsupportedError):
        FusedRuns(layout, data, noise, Own(False, False))


@pytest.fixture(scope="module")
def fitted():
    return fit(problem([record(BENCH, seed=3, n=150)]))


@pytest.mark.slow
def test_many_records_are_fitted_as_scipy_fits_them():
    free = {"Ixx": Free(0.03), "If": Free(2e-4)}
    flights = [record(BENCH, seed=k, n=150) for k in range(24)]
    notes: list[str] = []
    at = fit(problem(flights[:1], free, nuisance=NONE)).reached
    [own] = at.data.flights
    u = at.layout.model.Inputs(x_roll=jnp.stack([f.inputs["x_roll"] for f in flights]))
    y = {"roll": jnp.stack([f.outputs["roll"] for f in flights])}

    def data(each):
        return at.data._replace(flights=(own._replace(inputs=each[0], outputs=each[1]),))

    found = optimise_many(at, data, len(flights), (u, y), notes.append)
    assert found.converged.all()
    assert notes == []  # as programs of machine code
    values = {n: value_of(at.layout, at.data, i, found.z[:, i]) for i, n in enumerate(free)}
    for k, flight in enumerate(flights[:6]):
        u, y = flight.inputs["x_roll"], flight.outputs["roll"]
        alone = scipy.optimize.least_squares(
            lambda v, u=u, y=y: response(BENCH | {"Ixx": v[0], "If": v[1]}, u, 0.02, True) - y,
            [0.024, 1.7e-4], x_scale=[1e-3, 1e-5], xtol=1e-14, ftol=1e-14, gtol=1e-14,
        )  # fmt: skip
        sd = np.sqrt(np.diag(np.linalg.inv(alone.jac.T @ alone.jac)) * 2.0 * alone.cost / 148)
        for name, value, spread in zip(free, alone.x, sd, strict=True):
            assert abs(values[name][k] - value) < 1e-2 * spread


def test_many_records_that_are_no_program_are_run_one_by_one(fitted, monkeypatch):
    few, notes = bootstrap(fitted, 2), []
    monkeypatch.setattr(many_runs, "_MANY", 2)
    monkeypatch.setattr(many_runs, "_refused", lambda _: "a model of straw (at straw.py:3)")
    again = bootstrap(fitted, 2, say=notes.append)
    assert notes
    np.testing.assert_array_equal(again.values["Ixx"], few.values["Ixx"])


def test_nothing_is_computed_where_the_data_leave_a_parameter_open(fitted):
    open_ = {n: e._replace(sd=None) if n == "If" else e for n, e in fitted.estimates.items()}
    poor = dataclasses.replace(fitted, estimates=open_, status="not-identifiable")
    found = intervals(poor, profiles=["Ixx"], runs=5)
    assert found.profiles == {}
    assert found.bootstrap is None
    with pytest.raises(ValueError, match="If"):
        bootstrap(poor, 5)
