"""Angles whose error is no white noise, as those that an autopilot integrates from its gyros."""

from heli_jax.dynamics.model import axes_of
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.decimated import is_decimated
from heli_jax.numerics.white_noise import wanders


def wandering_notes(problem: Problem) -> list[Finding]:
    """Of filter error, which takes every output's error for white noise: the angles whose is not.

    Args:
        problem: with its flights.
    """
    if not estimator_of(problem.method).process_noise:
        return []
    pairs = [(a.angle, a.rate) for a in axes_of(problem.model) if a.angle is not None]
    wandering = [
        (angle, rate)
        for angle, rate in pairs
        if any(_wanders_beside(f, angle, rate) for f in problem.flights)
    ]
    return [
        note(
            "noise.wandering-angle",
            f"The error of {angle} is no white noise, which the filter takes it for: it looks "
            "integrated from a gyro, as an autopilot's attitude is, and wanders. That can bias "
            f"every estimate: fit without {angle}, which says nothing that {rate} does not.",
            angle,
        )
        for angle, rate in wandering
    ]


def _wanders_beside(flight: Flight, angle: str, rate: str) -> bool:
    y = flight.outputs
    # A low-pass to a lower rate colours an angle of white noise by itself, as a camera's at 120 Hz.
    if not {angle, rate} <= set(y) or is_decimated(flight, angle):
        return False
    # Where the rate's is not white either, the whole log was smoothed or resampled.
    return wanders(y[angle]) and not wanders(y[rate])
