"""Mass, centre of mass and offsets of what a force/torque sensor carries, from its readings at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from controller_service.errors import ControllerError
from controller_service.model import Array, RobotModel
from schemas.errors import ConfigurationError

LEAST_POSES: Final = 4
"""Three directions of gravity fix the ten unknowns; a fourth tells whether they are right."""
MAXIMUM_CONDITION: Final = 50.0
"""Of the regressors with g of unit length; reached where all poses lie within about 3 degrees of each other."""


class CalibrationError(ControllerError):
    """Readings from which the carried body cannot be identified.

    Attributes:
        poses: number of poses given.
        condition: of the regressors; inf where it was not computed.

    """

    def __init__(self, message: str, poses: int, condition: float = math.inf) -> None:
        super().__init__(f"force/torque calibration: {message}")
        self.poses = poses
        self.condition = condition


@dataclass(frozen=True, slots=True)
class Payload:
    """The rigid body that a sensor carries, and the sensor's offset, in the sensor's frame.

    Raises:
        ConfigurationError: mass not positive, wrong shape, not finite.

    """

    mass: float
    """m [kg]."""
    first_moment: Array
    """m c (3,) [kg·m], c from the sensor frame's origin to the centre of mass."""
    wrench_offset: Array
    """[f₀; n₀] (6,) [N, N·m], what the sensor reads where nothing acts."""

    def __post_init__(self) -> None:
        if self.first_moment.shape != (3,) or self.wrench_offset.shape != (6,):
            raise ConfigurationError(
                f"payload: expected first_moment (3,) and wrench_offset (6,), got {self.first_moment.shape} and"
                f" {self.wrench_offset.shape}"
            )
        if not (self.mass > 0.0 and np.isfinite([self.mass, *self.first_moment, *self.wrench_offset]).all()):
            raise ConfigurationError(
                f"payload: mass {self.mass} kg, first_moment {self.first_moment} kg·m, wrench_offset"
                f" {self.wrench_offset}: the mass must be above 0 and all values finite; calibrate the sensor anew"
            )

    @property
    def centre_of_mass(self) -> Array:
        """C (3,) [m]."""
        centre: Array = self.first_moment / self.mass
        return centre


@dataclass(frozen=True, slots=True)
class PayloadFit:
    """What was identified, and how well. Deviations are standard deviations, with the noise the residuals show."""

    payload: Payload
    residual_force_rms: float
    """[N] of all 3P force readings."""
    residual_torque_rms: float
    """[N·m] of all 3P moment readings."""
    condition: float
    """Larger one of the two regressors' condition numbers, with g of unit length."""
    mass_deviation: float
    """[kg]."""
    first_moment_deviation: Array
    """(3,) [kg·m]."""
    offset_deviation: Array
    """(6,) [N, N·m]."""


@dataclass(frozen=True, slots=True)
class PayloadDifference:
    """Identified body less the URDF's."""

    mass: float
    """[kg]."""
    first_moment: Array
    """(3,) [kg·m]."""
    centre_of_mass: Array
    """(3,) [m]."""


@dataclass(frozen=True, slots=True)
class StaticPose:
    """A stretch at rest: mean joint angles and readings."""

    start_s: float
    end_s: float
    samples: int
    position: Array
    """(n,) [rad]."""
    wrench: Array
    """(6,) [N, N·m], as read."""


def identify_payload(gravity_in_sensor: Array, wrenches: Array) -> PayloadFit:
    """Identify m, m c, f₀, n₀ by least squares at static poses, section 2.2 of [Del Prete 2016].

    The sensor reads what its parent side exerts on the body that it carries. At rest and in free air, g in its axes:

        f = −m g + f₀
        n = g × m c + n₀

    m and f₀ stand in the forces alone, m c and n₀ in the moments alone, so these are two separate problems and need no
    weight between N and N·m. The rotational inertia does not show at rest.

    Args:
        gravity_in_sensor: g (P, 3) [m/s²] in the sensor's axes, one row a pose (`gravity_in_sensor`).
        wrenches: [f; n] (P, 6), mean readings.

    Raises:
        CalibrationError: fewer than `LEAST_POSES`, values that are not finite, directions of gravity too alike, a mass
            that is not positive.

    """
    poses = len(gravity_in_sensor)
    if gravity_in_sensor.shape != (poses, 3) or wrenches.shape != (poses, 6):
        raise CalibrationError(f"expected (P, 3) and (P, 6), got {gravity_in_sensor.shape} and {wrenches.shape}", poses)
    if poses < LEAST_POSES:
        raise CalibrationError(f"{poses} poses at rest, at least {LEAST_POSES} are needed; record more of them", poses)
    if not (np.isfinite(gravity_in_sensor).all() and np.isfinite(wrenches).all()):
        raise CalibrationError("a reading or a direction of gravity is not finite; leave this pose out", poses)
    scale = float(np.sqrt(np.mean(np.square(gravity_in_sensor).sum(axis=1))))
    if scale == 0.0:
        raise CalibrationError("gravity is zero, so the mass cannot show; calibrate under gravity", poses)
    unit = gravity_in_sensor / scale
    offset = np.tile(np.eye(3), (poses, 1))
    force = np.hstack((-unit.reshape(-1, 1), offset))
    moment = np.hstack((np.vstack([pin.skew(g) for g in unit]), offset))
    condition = max(float(np.linalg.cond(force)), float(np.linalg.cond(moment)))
    if not condition <= MAXIMUM_CONDITION:
        raise CalibrationError(
            f"the {poses} directions of gravity are too alike: condition {condition:.3g}, at most"
            f" {MAXIMUM_CONDITION:.0f}; weight and offset cannot be told apart. Turn the sensor about two horizontal"
            " axes between the poses, by 20 degrees or more.",
            poses,
            condition,
        )
    x, x_deviation, force_rms = _solve(force, wrenches[:, :3].ravel())
    y, y_deviation, moment_rms = _solve(moment, wrenches[:, 3:].ravel())
    mass = float(x[0]) / scale
    if not mass > 0.0:
        raise CalibrationError(
            f"the mass comes out as {mass:.3g} kg, it must be above 0; check the sign of the readings (what the parent"
            " side exerts on the body) and of gravity, and that the sensor carries something",
            poses,
            condition,
        )
    return PayloadFit(
        Payload(mass, y[:3] / scale, np.concatenate((x[1:], y[3:]))),
        force_rms,
        moment_rms,
        condition,
        float(x_deviation[0]) / scale,
        y_deviation[:3] / scale,
        np.concatenate((x_deviation[1:], y_deviation[3:])),
    )


def static_poses(
    time_s: Array, position: Array, wrench: Array, *, speed_limit: float, least_s: float
) -> tuple[StaticPose, ...]:
    """Find the stretches at rest in a recording, and the means over each.

    At rest is every window of `least_s` in which no joint's angles span more than `speed_limit` · `least_s`, so that a
    flickering last count of an encoder is not taken for speed; windows that overlap make one stretch. A window with
    samples missing is not used.

    Args:
        time_s: (K,) [s], evenly spaced but for lost samples.
        position: (K, n) [rad], measured.
        wrench: (K, 6), measured.
        speed_limit: [rad/s].
        least_s: [s], shortest stretch.

    Raises:
        CalibrationError: wrong shapes, times that do not increase, values that are not finite, limits not positive.

    """
    count = len(time_s)
    if time_s.shape != (count,) or position.shape[:1] != (count,) or position.ndim != 2 or wrench.shape != (count, 6):
        raise CalibrationError(
            f"expected (K,), (K, n) and (K, 6), got {time_s.shape}, {position.shape} and {wrench.shape}", 0
        )
    if not (np.isfinite(time_s).all() and np.isfinite(position).all() and np.isfinite(wrench).all()):
        raise CalibrationError("the recording holds values that are not finite; cut them out", 0)
    if not (speed_limit > 0.0 and least_s > 0.0):
        raise CalibrationError(f"speed_limit {speed_limit} and least_s {least_s} must be above 0", 0)
    steps = np.diff(time_s)
    if count < 2 or not (steps > 0.0).all():
        raise CalibrationError("the times must increase, and be two or more; sort the recording", 0)
    period = float(np.median(steps))
    width = math.ceil(least_s / period - 1e-9) + 1
    if width > count:
        return ()
    # The filters' windows are centred at width // 2, so that of sample k starts at k − width // 2
    inner = slice(width // 2, width // 2 + count - width + 1)
    span = (maximum_filter1d(position, width, axis=0) - minimum_filter1d(position, width, axis=0))[inner]
    whole = time_s[width - 1 :] - time_s[: count - width + 1] < (width - 0.5) * period
    resting = (span <= speed_limit * least_s).all(axis=1) & whole
    # Two neighbours belong to one stretch when a window that holds both is at rest: a gap or a jump parts stretches
    before = np.concatenate(([0], np.cumsum(resting)))
    pairs = np.arange(count - 1)
    linked = before[np.minimum(pairs + 1, len(resting))] > before[np.maximum(pairs - width + 2, 0)]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], linked, [False])).astype(np.int8)))
    return tuple(
        StaticPose(
            float(time_s[start]),
            float(time_s[last]),
            int(last - start) + 1,
            position[start : last + 1].mean(axis=0),
            wrench[start : last + 1].mean(axis=0),
        )
        for start, last in edges.reshape(-1, 2)
    )


def gravity_in_sensor(model: RobotModel, positions: Array, frame: str, gravity_in_base: Array) -> Array:
    """Turn gravity into the sensor's axes at each pose: (P, 3) [m/s²] for `identify_payload`.

    Args:
        model: of the robot.
        positions: (P, n) [rad], in the description's order.
        frame: URDF link of the sensor.
        gravity_in_base: g (3,) [m/s²] in the root link's axes; with an IMU the negative of what `BaseMotion` holds.

    """
    return np.array([gravity_in_base @ model.pose(position, frame)[1] for position in positions]).reshape(-1, 3)


def payload_difference(payload: Payload, inertia: pin.Inertia) -> PayloadDifference:
    """Compare with the URDF's body in the sensor's frame (`TorqueEstimator.carried`)."""
    return PayloadDifference(
        payload.mass - inertia.mass,
        payload.first_moment - inertia.mass * inertia.lever,
        payload.centre_of_mass - inertia.lever,
    )


def _solve(matrix: Array, readings: Array) -> tuple[Array, Array, float]:
    """Least squares: solution, its standard deviations, root mean square of the residuals."""
    rows, unknowns = matrix.shape
    orthogonal, triangle = np.linalg.qr(matrix)
    inverse = np.linalg.inv(triangle)
    solution = inverse @ (orthogonal.T @ readings)
    square = float(np.square(readings - matrix @ solution).sum())
    deviation = np.sqrt(square / (rows - unknowns) * np.square(inverse).sum(axis=1))
    return solution, deviation, math.sqrt(square / rows)
