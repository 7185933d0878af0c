"""What can go wrong between the controller and the drives."""

from __future__ import annotations

from schemas.errors import CosimError


class HalError(CosimError):
    """Base of all errors of the hardware abstraction layer."""


class ProfileError(HalError):
    """Bytes that do not follow the drive profile or a sensor's layout."""


class BusLostError(HalError):
    """A bus is gone: its peer closed it, or the interface went down."""


class BootError(HalError):
    """A node could not be brought to operation; the message names joint, object and both values."""


class NodesMissingError(BootError):
    """Nodes did not appear in time; the message names all of them."""


class CommandRefused(HalError):  # noqa: N818 - a refusal is an answer, named as the event it becomes
    """A joint command is not fit to be applied; carries the field, its value and what was required."""

    def __init__(self, field: str, value: object, required: str, joint: str | None = None) -> None:
        self.field = field
        self.value = value
        self.required = required
        self.joint = joint
        where = f"joint {joint}: " if joint else ""
        super().__init__(f"{where}{field} is {value!r}, must be {required}")


class DriveFaultError(HalError):
    """A drive left operation or fell silent; carries joint, last state and error code."""

    def __init__(self, joint: str, state: str, error_code: int, text: str) -> None:
        self.joint = joint
        self.state = state
        self.error_code = error_code
        super().__init__(f"{text}\nThe HAL held the robot; remove the cause and start again: the boot resets faults.")
