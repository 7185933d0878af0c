"""One joint of the firmware as its simulated CiA 402 device sees it; implements `plant_service.axis.Axis`."""

from __future__ import annotations

from plant_service.axis import AxisGains
from plant_service.firmware import Firmware


class JointAxis:
    """The axis of one joint; all state is the firmware's."""

    __slots__ = ("_firmware", "_joint")

    def __init__(self, firmware: Firmware, joint: int) -> None:
        self._firmware = firmware
        self._joint = joint

    def position_counts(self) -> int:
        """Give the encoder position at this SYNC [counts]."""
        return self._firmware.counts[self._joint]

    def torque_per_mille(self) -> int:
        """Give the motor torque from the current at this SYNC [‰ of rated]."""
        return self._firmware.per_mille[self._joint]

    def power_off(self) -> None:
        """Switch the power stage off and the holding brake on."""
        self._firmware.power_off(self._joint)

    def follow_position(self, target_counts: int, max_torque_per_mille: int) -> None:
        """Move to a position in mode 8, see `Axis.follow_position`."""
        self._firmware.follow_position(self._joint, target_counts, max_torque_per_mille)

    def follow_torque(self, per_mille: int, max_torque_per_mille: int) -> None:
        """Give a torque in mode 10, see `Axis.follow_torque`."""
        self._firmware.follow_torque(self._joint, per_mille, max_torque_per_mille)

    def hold(self) -> None:
        """Hold by the drive's own means, see `Firmware.hold`."""
        self._firmware.hold(self._joint)

    def configure(self, gains: AxisGains) -> None:
        """Set firmware parameters."""
        self._firmware.configure(self._joint, gains)
