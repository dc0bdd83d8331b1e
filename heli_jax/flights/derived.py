"""Channels computed from those of a log: `euler(vehicle_attitude.q).roll` and similar.

There is a short list of named functions and no expressions, so a configuration can use only what is
defined here.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from heli_jax.errors import nearest
from heli_jax.flights.log import ChannelLog, Topic, as_floats, shown, wrong
from heli_jax.flights.marks import without_marks
from heli_jax.flights.resample import in_gaps

# Servo outputs of a swashplate, unmixed to collective and cyclic (CCPM).

_MOST_CONDITION = 100.0
"""Largest condition number of the mixing matrix. Beyond it, the servos are nearly on one line and
the result is noise."""


@dataclass(frozen=True)
class Swashplate:
    r"""Geometry of a swashplate's servos, and the scale of their channels.

    Seen from above, servo i is at the angle $\psi_i$ clockwise from the nose and the radius $r_i$.
    It lifts the plate by $s_i = (\text{channel}_i - \text{offset}_i)\,\text{scale}_i$, with the
    opposite sign if inverted. Because the plate is a plane,

    $$ s_i = c + r_i (\theta \cos(\psi_i - \gamma) - \phi \sin(\psi_i - \gamma)), $$

    with collective c, phase $\gamma$, and tilts $\phi$ (right side down) and $\theta$ (nose side
    up). More than three servos give a least-squares solution. Signs and angles follow ArduPilot's
    AP_MotorsHeli_Swash.

    Attributes:
        servos: channels, at least three.
        angles: psi by servo [deg].
        radius: r by servo, 1 by default: with r and lift in m, the tilt is in rad.
        offset: offset by servo, in the channel's unit.
        scale: lift per channel unit, by servo.
        invert: True by servo if a larger number lowers it.
        phase: gamma [deg].

    Raises:
        ValueError: lengths differ, a number is invalid, or the angles and radii do not separate
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
        # At a mean radius of 1, because in metres it is small beside the collective's coefficient
        # of 1.
        scaled = mixing_matrix(self) / np.array([1.0, *(np.mean(self.radius),) * 2])
        if np.linalg.cond(scaled) > _MOST_CONDITION:
            raise ValueError(
                f"angles: {list(self.angles)} deg do not separate collective and cyclic, expected "
                "three servos that are not on one line"
            )


def mixing_matrix(swashplate: Swashplate) -> np.ndarray:
    """Return the mixing matrix (n, 3): lift of each of n servos per collective, roll and pitch."""
    psi = np.deg2rad(np.asarray(swashplate.angles) - swashplate.phase)
    radius = np.asarray(swashplate.radius)
    return np.stack([np.ones_like(psi), -radius * np.sin(psi), radius * np.cos(psi)], axis=1)


def unmix(swashplate: Swashplate, channels: np.ndarray) -> np.ndarray:
    """Return collective, roll and pitch (3, N) from the servos' channels (n, N); NaN stays NaN."""

    def column(values: tuple[float, ...]) -> np.ndarray:
        return np.asarray(values, np.float64)[:, None]

    signs = np.where(np.asarray(swashplate.invert), -1.0, 1.0)[:, None]
    lifts = (channels - column(swashplate.offset)) * column(swashplate.scale) * signs
    # The pseudo-inverse is one small matrix for all samples, and a NaN stays in its own sample.
    return np.linalg.pinv(mixing_matrix(swashplate)) @ lifts


EULER = ("roll", "pitch", "yaw")
BODY = ("u", "v", "w")
CCPM = ("ccpm.collective", "ccpm.roll", "ccpm.pitch")
"""Channels available if a configuration states the geometry of the swashplate."""
FORMS = (
    "euler(Q).roll, .pitch or .yaw",
    "body_velocity(Q, NORTH, EAST, DOWN).u, .v or .w",
    "unwrap(CHANNEL, PERIOD)",
)
_CALL = re.compile(r"\s*([A-Za-z_]\w*)\((.*)\)(?:\.(\w+))?\s*")
_LONGEST_NAME = 400


@dataclass(frozen=True)
class Derivation:
    """Computation of a derived channel.

    Attributes:
        groups: channels it is computed from. The last group has the clock of the result; a group
            shares one clock.
        compute: function of the groups' samples, (k, N) each on one clock, that returns samples
            (N,).
        unit: unit of the result; empty if it is that of the last group's channels.
    """

    groups: tuple[tuple[str, ...], ...]
    compute: Callable[..., np.ndarray]
    unit: str = ""


def derivation(
    name: str, known: Collection[str], swashplate: Swashplate | None = None
) -> Derivation | None:
    """Return the computation of a channel of this name; None for a plain channel.

    Raises:
        ValueError: it looks like a derived channel but is none.
    """
    # A column may have any name, also with parentheses, so the file's names have priority.
    if name in known or len(name) > _LONGEST_NAME:
        return None
    if name in CCPM:
        if swashplate is None:
            raise ValueError(
                f"{name} needs the swashplate's geometry, expected signals.ccpm with it"
            )
        unmixed = functools.partial(unmix, swashplate)
        return Derivation((swashplate.servos,), _row(unmixed, CCPM.index(name)), "1")
    match = _CALL.fullmatch(name)
    if not match:
        return None
    function, part = match[1], match[3] or ""
    arguments = [argument.strip() for argument in match[2].split(",")]
    expected = f"expected {', '.join(FORMS)}, got {shown(name)}"
    if function == "euler" and len(arguments) in (1, 4) and part in EULER:
        return Derivation(
            (_quaternion(arguments, known),), _row(euler_angles, EULER.index(part)), "rad"
        )
    if function == "body_velocity" and len(arguments) in (4, 7) and part in BODY:
        *q, north, east, down = arguments
        groups = (_quaternion(q, known), (north, east, down))
        return Derivation(groups, _row(body_velocity, BODY.index(part)))
    if function == "unwrap" and len(arguments) == 2 and not part:
        try:
            period = float(arguments[1])
        except ValueError:
            raise ValueError(expected) from None
        if not 0 < period < np.inf:
            raise ValueError(f"expected a positive period, got {arguments[1]!r:.40}")
        return Derivation(((arguments[0],),), lambda values: _unwrapped(values[0], period))
    if function not in ("euler", "body_velocity", "unwrap"):
        hint = nearest(function, ("euler", "body_velocity", "unwrap"))
        raise ValueError(f"no derived channel {shown(function)}{hint}")
    raise ValueError(expected)


def sources(name: str, known: Collection[str], swashplate: Swashplate | None = None) -> list[str]:
    """Return the log's own channels that a channel needs: itself, unless it is derived.

    Raises:
        ValueError: as `derivation`.
    """
    derived = derivation(name, known, swashplate)
    return [name] if derived is None else [n for group in derived.groups for n in group]


def _quaternion(arguments: Sequence[str], known: Collection[str]) -> tuple[str, ...]:
    """Return the names of the four parts w, x, y, z: q[0] to q[3], or Q1 to Q4."""
    if len(arguments) == 4:
        return tuple(arguments)
    indexed = tuple(f"{arguments[0]}[{i}]" for i in range(4))
    numbered = tuple(f"{arguments[0]}{i}" for i in range(1, 5))
    return numbered if numbered[0] in known else indexed


def _row(of: Callable[..., np.ndarray], row: int) -> Callable[..., np.ndarray]:
    return lambda *samples: of(*samples)[row]


def euler_angles(q: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (3, N) [rad] of quaternions (4, N), w first, of any nonzero norm.

    The rotation is from earth to body axes by yaw, pitch, roll (3-2-1). Roll and yaw are unwrapped.
    Source: J. Diebel, Representing attitude, Stanford, 2006, eqs 290 and 284.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = q / np.linalg.norm(q, axis=0)
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([_unwrapped(roll, 2 * np.pi), pitch, _unwrapped(yaw, 2 * np.pi)])


def body_velocity(q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return velocities (3, N) in body axes from those in earth axes (3, N).

    Args:
        q: attitude (4, N), w first, from earth to body axes.
        velocity: velocities in earth axes (3, N).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        q = q / np.linalg.norm(q, axis=0)
    w, r = q[0], q[1:]
    # The rotation by the conjugate, v - 2 w (r x v) + 2 r x (r x v).
    once = np.cross(r, velocity, axis=0)
    return velocity - 2 * w * once + 2 * np.cross(r, once, axis=0)


def _unwrapped(values: np.ndarray, period: float) -> np.ndarray:
    # Only finite values, because np.unwrap returns NaN after the first NaN.
    good = np.isfinite(values)
    out = np.array(values, np.float64)
    out[good] = np.unwrap(out[good], period=period)
    return out


@dataclass(frozen=True, eq=False)
class DerivedLog(ChannelLog):
    """Log whose derived channels are available by name."""

    swashplate: Swashplate | None = None

    def is_derived(self, name: str) -> bool:
        """True if a name is that of a derived channel, well formed or not."""
        try:
            return derivation(name, frozenset(self.names), self.swashplate) is not None
        except ValueError:
            return True

    def topic_of(self, name: str) -> Topic:
        """Return the topic that holds a channel; for a derived one, the topic with its clock."""
        # Searches all topics as `names` would, but without a tuple of thousands at every call.
        if any(name in topic.columns for topic in self.topics):
            return super().topic_of(name)
        place = f"channel {shown(name)}"
        try:
            derived = derivation(name, frozenset(self.names), self.swashplate)
        except ValueError as e:
            raise wrong(self.path, str(e), place) from e
        if derived is None:
            return super().topic_of(name)
        *others, last = [self._group(group, place) for group in derived.groups]
        blocks = [
            values if topic is last[0] else _on_clock(last[0].times, topic.times, values)
            for topic, values in others
        ]
        values = derived.compute(*blocks, last[1])
        # Angles are in rad whatever the log states; a velocity or a heading keeps its unit.
        stated = last[0].units.get(derived.groups[-1][0], "")
        units = {name: derived.unit or stated}
        return dataclasses.replace(last[0], columns={name: values}, units=units)

    def _group(self, names: Sequence[str], place: str) -> tuple[Topic, np.ndarray]:
        """Return the topic of channels that were written together, and their samples (k, N)."""
        topics = [super(DerivedLog, self).topic_of(name) for name in names]
        for name, topic in zip(names, topics, strict=True):
            if topic.name != topics[0].name:
                problem = f"{shown(names[0])} and {shown(name)} are of different topics, expected"
                raise wrong(self.path, f"{problem} channels of one", place)
        values = [as_floats(t.columns[n]) for n, t in zip(names, topics, strict=True)]
        # Before anything is computed, because the result of a -9999 looks like an angle or a speed.
        return topics[0], np.stack([without_marks(x) for x in values])


def _on_clock(times: np.ndarray, clock: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Interpolate quaternions (4, M) of a clock (M,) linearly to other times (N,)."""
    if clock.size < 2 or np.any(np.diff(clock) <= 0):
        return np.full((len(q), times.size), np.nan)
    # q and -q are the same attitude, but the line between them passes through zero.
    flips = np.where(np.sum(q[:, 1:] * q[:, :-1], axis=0) < 0, -1.0, 1.0)
    q = q * np.concatenate([[1.0], np.cumprod(flips)])
    between = np.stack([np.interp(times, clock, row, np.nan, np.nan) for row in q])
    # In a gap the attitude is unknown, so the velocity is missing.
    between[:, in_gaps(clock, times)] = np.nan
    return between


def with_derived(log: ChannelLog, swashplate: Swashplate | None = None) -> DerivedLog:
    """Return a log whose derived channels are available by name."""
    fields = {field.name: getattr(log, field.name) for field in dataclasses.fields(ChannelLog)}
    return DerivedLog(**fields, swashplate=swashplate)
