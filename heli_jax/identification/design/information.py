r"""Information of a planned experiment, differentiable by its inputs.

The rows of a method are evaluated at the outputs that the model expects for the inputs. Their
Jacobian J by the unknowns gives Fisher's matrix J'J (Mehra, 1974). With filter error, gusts and
noise move the outputs too; the information of those motions does not depend on the inputs of a
linear model. It is averaged once over random records and added.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.estimation.evaluation import named
from heli_jax.identification.estimation.residual import weak_rows
from heli_jax.identification.estimation.simulated_flights import Drive, driven, simulated_flight
from heli_jax.identification.identifiability.analysis import relative_slopes, unknowns_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.simulation.hold import at

# Inputs, Params and State are Any, because they are a model's own classes.

type Feedback = Callable[[Any, Any], Any]
"""feedback(state, inputs) -> acting Inputs, as in `SimulationOptions`."""

_WEAK = 0.01
"""Row of each unknown, so that a covariance exists: an sd of 100 times its value."""
_DRAWS = 8
"""Random records for the information of gusts."""


class Flown(NamedTuple):
    """The experiment as the model flies it."""

    data: Data
    """With the outputs, and the inputs as they are recorded: with feedback those that act."""
    motion: tuple[dict[str, Array], ...]
    """Acting inputs, states and outputs (N,) by flight and name, SI; outputs of a state's name take
    its place."""
    before: tuple[dict[str, Array], ...]
    """Outputs (N - 1,) by flight and name just before the next sample's inputs act, SI."""


@jax.custom_vjp
def covariance(rows: Float[Array, "n q"]) -> Float[Array, "q q"]:
    """Return (rows' rows)^-1, with a derivative that keeps the accuracy of the triangular
    factor."""
    R = jnp.linalg.qr(rows, mode="r")
    inverse = jax.scipy.linalg.solve_triangular(R, jnp.eye(R.shape[0], dtype=R.dtype))
    return inverse @ inverse.T


def _forward(rows: Array) -> tuple[Array, tuple[Array, Array]]:
    C = covariance(rows)
    return C, (rows, C)


def _backward(kept: tuple[Array, Array], by_C: Array) -> tuple[Array]:
    # dC = -C (dJ' J + J' dJ) C.
    rows, C = kept
    return (-rows @ (C @ (by_C + by_C.T) @ C),)


covariance.defvjp(_forward, _backward)


class Vehicle(NamedTuple):
    """One set of unknowns; with a leading axis, several vehicles side by side."""

    z: Any
    scales: Any
    """Derivatives of z by the relative coordinates (q,)."""
    rows: Any
    """Rows of information that no input changes: priors, gusts, other flights (r, q)."""


class Outcome(NamedTuple):
    """Accuracy and motion of a vehicle; with a leading axis, of several."""

    covariance: Float[Array, "*v p p"]
    """Of the parameters, in relative coordinates."""
    motion: tuple[dict[str, Array], ...]
    """As in `Flown`."""
    before: tuple[dict[str, Array], ...]
    """As in `Flown`."""


class Experiment(NamedTuple):
    """A planned experiment: everything except its inputs."""

    problem: Problem
    layout: Layout
    data: Data
    """Its flights give the sample times, the measured outputs and the first inputs."""
    noise: Noise
    feedback: Feedback | None
    vehicles: Vehicle
    """(v, ...), the vehicles for which the experiment is meant."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters of interest, the first in every covariance."""
        return self.layout.of_interest

    def outcome(self, inputs: tuple[Any, ...], known: tuple[dict[str, Any], ...]) -> Outcome:
        """Return the accuracy and the motion, for each vehicle.

        Args:
            inputs: the model's Inputs (N,) of each flight, SI; with feedback what is given to it.
            known: known parameters of each flight.
        """
        p = len(self.parameters)

        def of_one(vehicle: Vehicle) -> Outcome:
            flown = self.flown(vehicle, inputs, known)
            rows = jnp.concatenate([self._rows(vehicle, flown.data), vehicle.rows])
            return Outcome(covariance(rows)[:p, :p], flown.motion, flown.before)

        return jax.vmap(of_one)(self.vehicles)

    def flown(
        self,
        vehicle: Vehicle,
        inputs: tuple[Any, ...],
        known: tuple[dict[str, Any], ...],
        keys: Array | None = None,
    ) -> Flown:
        """Return the experiment in calm air, or with the gusts of a key for each flight."""
        layout = self.layout
        flights = zip(self.data.flights, inputs, known, strict=True)
        given = tuple(f._replace(inputs=u, known={**f.known, **k}) for f, u, k in flights)
        data = self.data._replace(flights=given)
        u = unpack(layout, data, vehicle.z)
        flown, motion, before = [], [], []
        for i, names in enumerate(layout.outputs):
            # A shift is zero at the start.
            options = {"feedback": self.feedback}
            if keys is not None or self.feedback is not None:
                options |= {"block": 1, "key": None if keys is None else keys[i]}
            drive = driven(layout, data, u, i)
            run = simulated_flight(layout, i, drive, None, **options)
            # The record has the inputs as commanded: the rows delay them again.
            inputs = given[i].inputs if self.feedback is None else run.inputs
            outputs = {n: getattr(run.outputs, n) for n in names}
            flown.append(given[i]._replace(inputs=inputs, outputs=outputs))
            parts = (run.inputs, run.states, run.outputs)
            motion.append({n: x for part in parts for n, x in naming.asdict(part).items()})
            now = jax.tree.map(lambda v: v[1:], run.states)
            earlier = jax.tree.map(lambda v: v[:-1], run.inputs)
            # An output with direct feedthrough jumps at a sample.
            output = jax.vmap(lambda x, u, p=drive.params: layout.model.output(p, x, u))
            before.append(naming.asdict(output(now, earlier)))
        return Flown(data._replace(flights=tuple(flown)), tuple(motion), tuple(before))

    def state_matrices(self) -> list[Float[Array, "n n"]]:
        """Return the first vehicle's state matrix, with feedback, at the begin of each flight."""
        layout, data = self.layout, self.data
        u = unpack(layout, data, self.vehicles.z[0])
        found, model = [], layout.model
        for i in range(len(data.flights)):
            drive = driven(layout, data, u, i)
            begin = model.initial_state(drive.params) if drive.state is None else drive.state

            def rates(x: Array, drive: Drive = drive) -> Array:
                state, inputs = naming.unravel(model.State, x), at(drive.inputs, 0)
                inputs = inputs if self.feedback is None else self.feedback(state, inputs)
                return naming.ravel(model.vector_field(drive.params, state, inputs))

            found.append(jax.jacfwd(rates)(naming.ravel(begin)))
        return found

    def _rows(self, vehicle: Vehicle, data: Data) -> Float[Array, "n q"]:
        """Return the rows of the measurements and of the weak priors of nuisances."""
        layout, noise, z = self.layout, self.noise, vehicle.z

        # The measured outputs are given, so they have no derivative by the unknowns.
        def rows(z: Array) -> Array:
            measured = layout.objective.residuals(layout, data, noise, unpack(layout, data, z))
            return jnp.concatenate([measured.rows, weak_rows(layout, z)])

        columns = jnp.diag(vehicle.scales)
        return jax.vmap(lambda v: jax.jvp(rows, (z,), (v,))[1], out_axes=-1)(columns)


def planned(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    points: Float[np.ndarray, "v q"],
    feedback: Feedback | None = None,
    flown: Float[np.ndarray, "r s"] | None = None,
) -> Experiment:
    """Return the experiment of a problem, whose flights state lengths, outputs and noise.

    Args:
        points: the unknowns of each vehicle.
        flown: rows of the information of earlier flights on the shared unknowns; without them
            that of gusts is computed.
    """
    layout = replace(layout, reverse=True)
    scales = np.ones(points.shape)
    rows = np.tile(_WEAK * np.eye(layout.size), (len(points), 1, 1))
    for z, own, prior in zip(points, scales, rows, strict=True):
        values, slopes = map(np.asarray, named(layout, data, jnp.asarray(z)))
        unknowns = unknowns_of(problem, layout, values)
        own[: slopes.size] = relative_slopes(unknowns, slopes)
        for i, unknown in enumerate(unknowns):
            prior[i, i] = max(unknown.prior, _WEAK)
    if flown is not None:
        more = np.pad(flown, ((0, 0), (0, layout.size - flown.shape[1])))
        rows = np.concatenate([rows, np.tile(more, (len(points), 1, 1))], axis=1)
    vehicles = Vehicle(*map(jnp.asarray, (points, scales, rows)))
    experiment = Experiment(problem, layout, data, noise, feedback, vehicles)
    if layout.noise_model != "disturbance" or flown is not None:
        return experiment
    rows = jnp.concatenate([vehicles.rows, _of_gusts(experiment)], axis=1)
    return experiment._replace(vehicles=vehicles._replace(rows=rows))


def _of_gusts(experiment: Experiment) -> Float[Array, "v q q"]:
    """Return the factor of the information that gusts and noise give by themselves."""
    flights, noise = experiment.data.flights, experiment.noise
    inputs = tuple(f.inputs for f in flights)
    known = tuple(dict[str, Any]() for _ in flights)

    def information(vehicle: Vehicle, key: Array) -> Array:
        calm = experiment.flown(vehicle, inputs, known).data
        of_gusts, of_noise = (jax.random.split(k, len(flights)) for k in jax.random.split(key))
        gusty = experiment.flown(vehicle, inputs, known, of_gusts).data
        noisy = tuple(
            f._replace(outputs=_with_noise(f.outputs, sd, k))
            for f, sd, k in zip(gusty.flights, noise.sd, of_noise, strict=True)
        )
        gusty = gusty._replace(flights=noisy)
        more = experiment._rows(vehicle, gusty) - experiment._rows(vehicle, calm)
        return more.T @ more

    @jax.jit
    def factor(vehicle: Vehicle) -> Array:
        keys = jax.random.split(jax.random.key(0), _DRAWS)
        F = jnp.mean(jax.lax.map(lambda key: information(vehicle, key), keys), axis=0)
        sizes, V = jnp.linalg.eigh(F)
        return jnp.sqrt(jnp.maximum(sizes, 0.0))[:, None] * V.T

    return jax.lax.map(factor, experiment.vehicles)


def _with_noise(outputs: dict[str, Array], sd: dict[str, Any], key: Array) -> dict[str, Array]:
    keys = jax.random.split(key, len(outputs))
    return {
        n: y + sd[n] * jax.random.normal(k, y.shape, y.dtype)
        for k, (n, y) in zip(keys, outputs.items(), strict=True)
    }
