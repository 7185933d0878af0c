"""Friction of geared joints as the controller believes it, and the share of it that is given to the motors in advance.

The model is τ_f = c sign(q̇) + v q̇ at the joint. A share s of it, smooth at zero velocity, is added to the law's torque:

    τ_fc = s (c tanh(q̇/v_0) + v q̇)

**Passive at any delay.** The velocity is an estimate that is late (half a period and a filter), and the torque acts
a cycle later still. Let the true friction be at least s c + s v |q̇|. The Coulomb part never exceeds s c, so its
power is at most s c |q̇| whatever velocity it believes; the viscous part is s v times a mean, a low-pass, a delay
and a hold of q̇, none of which has an L2 gain above 1. So ∫ τ_fc q̇ dt ≤ ∫ |τ_f q̇| dt over any motion from rest
(an encoder's count adds s v counts/T, far below the margin of the Coulomb part). At rest |τ_fc| ≤ s c lies below
breakaway and the joint stays. A joint by itself thus has no limit cycle, at any slope and any delay: it only takes
longer to come to rest.

**Slow motion in a position loop** does bound the slope. Near zero velocity the compensation is a negative damping;
its viscous part is covered by the true viscous friction, but sliding dry friction is constant and has nothing to
set against κ = s c/v_0. With I = M_jj and the delay D of velocity and command, motion below v_0 obeys

    I ẍ + I (λ + K_v − κ/I) ẋ(t − D) + … = 0:

the compensation takes from the loop's damping, and what is left has the wider delay margin, (λ + K_v − κ/I) D <
π/2. So slope times delay has no bound of its own but the loop's, κ D/I < (λ + K_v) D, which the stiffness narrows
(Routh, of (p + λ)(p² + K_v p + K_p) − (κ/I) p²) to

    κ < I (λ + K_v − λ K_p / (K_p + λ K_v)).

Above it a joint that is passive by itself sticks and slips between rest and a few v_0 under such a loop. The fall
from breakaway to sliding friction can start the same from about 0.6 of it; half of it is safe, v_0 ≥ s c over that
(`slope_limit`). Well above v_0 motion is smooth in any case.

The torque that starts a joint is not reduced, since τ_fc is zero at rest; the torque that keeps it moving is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from controller_service.model import Array
from schemas.control_law import FrictionCompensation, JointFriction
from schemas.controller import TaskGains
from schemas.errors import ConfigurationError
from schemas.robot import RobotDescription


def slope_limit(inertia: Array, lambda_: float, gains: TaskGains) -> Array:
    """Largest s c/v_0 (n,) [N·m·s/rad] with which slow motion stays smooth: half the bound of the module's text.

    Args:
        inertia: diag(M) (n,) [kg·m²].
        lambda_: λ of the integral term [1/s].
        gains: K_p and K_v of the task that moves the joints.

    """
    ratio = gains.stiffness / (gains.stiffness + lambda_ * gains.damping) if gains.stiffness > 0.0 else 0.0
    limit: Array = 0.5 * (lambda_ * (1.0 - ratio) + gains.damping) * inertia
    return limit


def refuse_unknown_joints(description: RobotDescription, names: Iterable[str], field: str) -> None:
    """Refuse names of a configuration's `field` that the robot does not have.

    Raises:
        ConfigurationError: naming field, joint and the known ones.

    """
    for name in names:
        if name not in description.joint_names:
            raise ConfigurationError(
                f"{field}: robot {description.name} has no joint {name!r}; it has {', '.join(description.joint_names)}"
            )


class FrictionModel:
    """c and v of n joints, at the joint and in the order of the description.

    Args:
        description: gear ratios N; c = N c_motor, v = N² v_motor.
        coulomb: c_motor [N·m], of every joint without an entry in `joints`.
        viscous: v_motor [N·m·s/rad].
        joints: identified friction of joints, at the joint.
        field: of the configuration, for messages.

    Raises:
        ConfigurationError: `joints` names a joint that the robot does not have.

    """

    def __init__(
        self,
        description: RobotDescription,
        coulomb: float,
        viscous: float,
        joints: Mapping[str, JointFriction] | None = None,
        field: str = "controller.friction_compensation.joints",
    ) -> None:
        entries = joints or {}
        refuse_unknown_joints(description, entries, field)
        gear = np.array([joint.gear_ratio for joint in description.joints])
        self.coulomb: Array = coulomb * gear
        """c (n,) [N·m]."""
        self.viscous: Array = viscous * gear * gear
        """v (n,) [N·m·s/rad]."""
        for index, name in enumerate(description.joint_names):
            if name in entries:
                self.coulomb[index], self.viscous[index] = entries[name].coulomb, entries[name].viscous
        self.coulomb.setflags(write=False)
        self.viscous.setflags(write=False)


class FrictionCompensator:
    """τ_fc = s (c tanh(q̇/v_0) + v q̇): odd, zero at rest, Lipschitz with s (c/v_0 + v). See the module.

    Args:
        description: names and gears of the joints.
        config: model, share s and v_0.

    Raises:
        ConfigurationError: an entry for a joint that the robot does not have.

    """

    def __init__(self, description: RobotDescription, config: FrictionCompensation) -> None:
        self.model = FrictionModel(description, config.coulomb, config.viscous, config.joints)
        self._coulomb = config.share * self.model.coulomb
        self._viscous = config.share * self.model.viscous
        self._per_velocity = np.full(len(self._coulomb), 1.0 / config.smoothing_velocity)

    @property
    def slope(self) -> Array:
        """Largest slope, s (c/v_0 + v) (n,) [N·m·s/rad]."""
        slope: Array = self.dry_slope + self._viscous
        return slope

    @property
    def dry_slope(self) -> Array:
        """κ = s c/v_0 (n,) [N·m·s/rad], to lie below `slope_limit`."""
        slope: Array = self._coulomb * self._per_velocity
        return slope

    def torque(self, velocity: Array) -> Array:
        """τ_fc (n,) [N·m] in the direction of motion, to be added to the motor torque.

        Args:
            velocity: q̇ estimated (n,) [rad/s].

        """
        torque: Array = velocity * self._per_velocity
        np.tanh(torque, out=torque)
        torque *= self._coulomb
        torque += velocity * self._viscous
        return torque
