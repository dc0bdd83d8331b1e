"""Servo outputs of a swashplate, unmixed to collective and cyclic (CCPM)."""

from dataclasses import dataclass

import numpy as np

_MOST_CONDITION = 100.0
"""of the mixing matrix: beyond it servos are so near to one line that noise is all there is"""


@dataclass(frozen=True)
class Swashplate:
    r"""Where a swashplate's servos lift it, and what their channels mean.

    Servo i, seen from above at the angle $\psi_i$ clockwise from the nose and at the radius $r_i$,
    lifts the plate by $s_i = (\text{channel}_i - \text{offset}_i)\,\text{scale}_i$, with the other
    sign where it is inverted. The plate being a plane,

    $$ s_i = c + r_i (\theta \cos(\psi_i - \gamma) - \phi \sin(\psi_i - \gamma)), $$

    with the collective c, the tilt $\phi$ (down to the right, which rolls right) and $\theta$ (up
    at the nose, which pitches up) and the phase $\gamma$. With more than three servos the three
    are the least-squares solution. Source: signs and angles are those of ArduPilot's
    AP_MotorsHeli_Swash.

    Attributes:
        servos: channels, at least three.
        angles: psi by servo [deg].
        radius: r by servo, at 1 unless given: in m with a lift in m the tilt is in rad.
        offset: by servo, in the channel's unit.
        scale: by servo, lift in the channel's unit.
        invert: by servo, whether a larger number lowers it.
        phase: gamma [deg].

    Raises:
        ValueError: lengths differ, a number makes no sense, or the angles and radii do not tell
            collective from cyclic.
    """

    servos: tuple[str, ...]
    angles: tuple[float, ...]
    radius: tuple[float, ...]
    offset: tuple[float, ...]
    scale: tuple[float, ...]
    invert: tuple[bool, ...]
    phase: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.servos)
        if count < 3:
            raise ValueError(f"servos: expected at least three, got {count}")
        if len(set(self.servos)) < count:
            raise ValueError("servos: expected different channels, got one twice")
        for name in ("angles", "radius", "offset", "scale", "invert"):
            if len(getattr(self, name)) != count:
                got = len(getattr(self, name))
                raise ValueError(f"{name}: expected one for each of {count} servos, got {got}")
        if not all(r > 0 for r in self.radius):
            raise ValueError("radius: expected positive numbers")
        if not all(k != 0 for k in self.scale):
            raise ValueError("scale: expected numbers other than 0")
        # At a mean radius of 1: in metres it is small beside a collective that counts as 1.
        scaled = mixing_matrix(self) / np.array([1.0, *(np.mean(self.radius),) * 2])
        if np.linalg.cond(scaled) > _MOST_CONDITION:
            raise ValueError(
                f"angles: {list(self.angles)} deg do not tell collective from cyclic, expected "
                "three servos that are not on one line"
            )


def mixing_matrix(swashplate: Swashplate) -> np.ndarray:
    """(n, 3), what collective, roll and pitch lift each of n servos by."""
    psi = np.deg2rad(np.asarray(swashplate.angles) - swashplate.phase)
    radius = np.asarray(swashplate.radius)
    return np.stack([np.ones_like(psi), -radius * np.sin(psi), radius * np.cos(psi)], axis=1)


def unmix(swashplate: Swashplate, channels: np.ndarray) -> np.ndarray:
    """Collective, roll and pitch (3, N) from the servos' channels (n, N); NaN where one is."""

    def column(values: tuple[float, ...]) -> np.ndarray:
        return np.asarray(values, np.float64)[:, None]

    signs = np.where(np.asarray(swashplate.invert), -1.0, 1.0)[:, None]
    lifts = (channels - column(swashplate.offset)) * column(swashplate.scale) * signs
    # By the pseudo-inverse: one small matrix for all samples, and a NaN stays in its own sample.
    return np.linalg.pinv(mixing_matrix(swashplate)) @ lifts
