"""One drive as the boot sees it: NMT commands, boot-up, heartbeats, typed SDO access over a frame port."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, cast

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from hal import sdo_client
from hal.errors import BootError
from hal.profile import identifiers, objects
from hal.sdo_client import SDO_REQUEST, PortNetwork, PumpedNode, PumpedSdoClient, profile_dictionary, profile_variable

NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
UNSUPPORTED_ACCESS = 0x06010000
READ_ONLY = 0x06010002
_UPLOAD: Final = 0x40
_DOWNLOAD_2_BYTES: Final = 0x2B


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a drive did not take a value."""

    text: str
    """Names joint, object, value and reason."""
    absent: bool
    """The drive has no such object."""


class NodeLink:
    """One drive on its bus: typed SDO access by index, NMT commands, what it says of its own life.

    Object types come from the profile's EDS, which holds every object the HAL uses.
    """

    def __init__(self, network: PortNetwork, node_id: int, joint: str) -> None:
        self.network = network
        self.node_id = node_id
        self.joint = joint
        self.where = f"joint {joint} (node {node_id} on bus {network.port.name})"
        self.boot_ups = 0
        """Boot-up messages heard."""
        self.heartbeats = 0
        """Heartbeats heard, boot-up messages apart."""
        self.answers = 0
        """SDO answers heard."""
        self._node = PumpedNode(node_id, profile_dictionary())
        network.add_node(self._node)
        network.subscribe(identifiers.HEARTBEAT + node_id, self._on_heartbeat)
        network.subscribe(identifiers.SDO_TX + node_id, self._on_answer)

    @property
    def echoes(self) -> float:
        """Share of the SDO requests that were answered twice, as by two devices with one node id."""
        client = cast(PumpedSdoClient, self._node.sdo)
        return client.echoes / max(client.requests, 1)

    def command(self, nmt_command: int) -> None:
        """Send an NMT command to this node alone."""
        self._node.nmt.send_command(nmt_command)

    def ask(self) -> None:
        """Ask for the device type without waiting: `answers` grows when the node is alive."""
        self._request(_UPLOAD, objects.DEVICE_TYPE, 0)

    def order(self, controlword: int) -> None:
        """Write the controlword without waiting: `answers` grows when the node has heard of it."""
        self._request(_DOWNLOAD_2_BYTES, objects.CONTROLWORD, controlword)

    def read(self, index: int, subindex: int = 0) -> int:
        """Read an object by SDO.

        Raises:
            BootError: the device refuses or does not answer.
            BusLostError: the bus is gone.

        """
        value = self.read_optional(index, subindex)
        if value is None:
            raise BootError(f"{self.where}: the device has no object 0x{index:04X}:{subindex}, which the HAL needs")
        return value

    def read_optional(self, index: int, subindex: int = 0) -> int | None:
        """Read as `read`; None when the device has no such object."""
        try:
            data = self._node.sdo.upload(index, subindex)
        except SdoAbortedError as error:
            if error.code in (NO_OBJECT, NO_SUBINDEX):
                return None
            raise BootError(f"{self.where}: SDO read at 0x{index:04X}:{subindex} refused: {error}") from error
        except SdoCommunicationError as error:
            raise self._silent("read", index, subindex, error) from error
        variable = profile_variable(index, subindex)
        if len(data) * 8 != len(variable):
            raise BootError(
                f"{self.where}: object 0x{index:04X}:{subindex} has {len(data)} bytes, must have {len(variable) // 8}"
            )
        return int(variable.decode_raw(data))

    def peek(self, index: int, subindex: int = 0) -> int | None:
        """Read as `read`; None when the device refuses for whatever reason, or has something of another length.

        Raises:
            BootError: the device does not answer.
            BusLostError: the bus is gone.

        """
        variable = profile_variable(index, subindex)
        try:
            data = self._node.sdo.upload(index, subindex)
        except SdoAbortedError:
            return None
        except SdoCommunicationError as error:
            raise self._silent("read", index, subindex, error) from error
        return int(variable.decode_raw(data)) if len(data) * 8 == len(variable) else None

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write an object by SDO.

        Raises:
            BootError: the device refuses or does not answer.
            BusLostError: the bus is gone.

        """
        refusal = self.try_write(index, subindex, value)
        if refusal is not None:
            raise BootError(refusal.text)

    def try_write(self, index: int, subindex: int, value: int) -> Refusal | None:
        """Write an object by SDO; None when it holds the value now, even if the device lets nobody write it.

        Raises:
            BootError: the device does not answer.
            BusLostError: the bus is gone.

        """
        variable = profile_variable(index, subindex)
        try:
            self._node.sdo.download(index, subindex, variable.encode_raw(value))
        except SdoAbortedError as error:
            absent = error.code in (NO_OBJECT, NO_SUBINDEX)
            held = None if absent else self.peek(index, subindex)
            if held == value:
                return None
            if held is not None and error.code in (READ_ONLY, UNSUPPORTED_ACCESS):
                reason = f"is fixed at {held}, must be {value}; correct the robot description or the drive's set-up"
                return Refusal(f"{self.where}: object 0x{index:04X}:{subindex} {reason}", absent)
            action = f"SDO write of {value:#x} at 0x{index:04X}:{subindex}"
            return Refusal(f"{self.where}: {action} refused: {error}", absent)
        except SdoCommunicationError as error:
            raise self._silent("write", index, subindex, error) from error
        return None

    def _request(self, command: int, index: int, value: int) -> None:
        self.network.send_message(identifiers.SDO_RX + self.node_id, SDO_REQUEST.pack(command, index, 0, value))

    def _on_heartbeat(self, _can_id: int, data: bytearray, _timestamp: float) -> None:
        if bytes(data) == bytes((identifiers.HEARTBEAT_BOOT_UP,)):
            self.boot_ups += 1
        else:
            self.heartbeats += 1

    def _on_answer(self, _can_id: int, _data: bytearray, _timestamp: float) -> None:
        self.answers += 1

    def _silent(self, verb: str, index: int, subindex: int, error: SdoCommunicationError) -> BootError:
        return BootError(
            f"{self.where}: SDO {verb} of 0x{index:04X}:{subindex} failed ({error};"
            f" waited {sdo_client.SDO_TIMEOUT_S:g} s); check the drive's power and the bus"
        )
