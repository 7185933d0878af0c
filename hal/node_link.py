"""CANopen services of the HAL over frame ports: NMT, boot-up, heartbeats, SDO; no threads, every frame passes the port.

The `canopen` library does the protocols. Its network is fed from the port while somebody waits, so the frames of a boot
depend on the drives' answers alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from struct import Struct
from typing import Final, cast

import canopen
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from hal.bus.ports import FramePort
from hal.errors import BootError
from hal.profile import identifiers, objects
from hal.profile.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, pack, unpack

SDO_TIMEOUT_S = 3.0
"""Wait for one SDO answer; a request is never repeated, so that logs of equal runs are equal."""
NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
UNSUPPORTED_ACCESS = 0x06010000
READ_ONLY = 0x06010002
SYNC_WINDOW_US: Final = 0x1007
PDO_RECORDS_END = 0x1C00
_NOT_FOR_CANOPEN = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG
_REQUEST = Struct("<BHBI")
_UPLOAD, _DOWNLOAD_2_BYTES, _ABORT = 0x40, 0x2B, 0x80
_GENERAL_ERROR: Final = 0x08000000


class PortNetwork(canopen.Network):
    """A `canopen.Network` over a `FramePort`, driven by whoever waits for something."""

    def __init__(self, port: FramePort) -> None:
        super().__init__()
        self.port = port

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send one frame; `data` is anything that `bytes` takes."""
        self.port.send(pack(can_id | (CAN_RTR_FLAG if remote else 0), bytes(data)))

    def pump(self, timeout_s: float) -> None:
        """Feed what arrives within `timeout_s` [s] to the services; returns after the first packet.

        Raises:
            BusLostError: the bus is gone.

        """
        for can_id, data in unpack(self.port.receive(timeout_s)):
            if not can_id & _NOT_FOR_CANOPEN:
                self.notify(can_id, bytearray(data), 0.0)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Pump until the condition holds; whether it did within `timeout_s` [s]."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                self.pump(0.0)
                return condition()
            self.pump(remaining)
        return True


class _PumpedSdoClient(SdoClient):
    RESPONSE_TIMEOUT = 0.001
    MAX_RETRIES = 1
    """Attempts altogether, in the library's counting."""

    def read_response(self) -> bytes:
        network = cast(PortNetwork, self.network)
        network.wait_until(lambda: not self.responses.empty(), SDO_TIMEOUT_S)
        return cast(bytes, super().read_response())  # type: ignore[no-untyped-call]  # the library is untyped

    def abort(self, abort_code: int = _GENERAL_ERROR) -> None:
        """Abort the transfer; unlike the library's, nothing is printed: whoever waited for it tells of it."""
        self.send_request(_REQUEST.pack(_ABORT, 0, 0, abort_code))  # type: ignore[no-untyped-call]  # as above

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object; unlike the library's, data of another length than the dictionary's are not cut to fit."""
        with self.open(index, subindex, buffering=0) as stream:  # type: ignore[no-untyped-call]  # as above
            data = cast(bytes, stream.read())
            size_given = stream.size is not None
        return data if size_given else data[: len(_variable(index, subindex)) // 8]


class _PumpedNode(canopen.RemoteNode):
    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> SdoClient:
        client = _PumpedSdoClient(rx_cobid, tx_cobid, self.object_dictionary)  # type: ignore[no-untyped-call]  # as above
        self.sdo_channels.append(client)
        if self.has_network():
            self.network.subscribe(tx_cobid, client.on_response)
        return client


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
        self._node = _PumpedNode(node_id, _dictionary())
        network.add_node(self._node)
        network.subscribe(identifiers.HEARTBEAT + node_id, self._on_heartbeat)
        network.subscribe(identifiers.SDO_TX + node_id, self._on_answer)

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
        variable = _variable(index, subindex)
        if len(data) * 8 != len(variable):
            raise BootError(
                f"{self.where}: object 0x{index:04X}:{subindex} has {len(data)} bytes, must have {len(variable) // 8}"
            )
        return int(variable.decode_raw(data))

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
        variable = _variable(index, subindex)
        try:
            self._node.sdo.download(index, subindex, variable.encode_raw(value))
        except SdoAbortedError as error:
            absent = error.code in (NO_OBJECT, NO_SUBINDEX)
            held = None if absent else self._held(index, subindex)
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

    def _held(self, index: int, subindex: int) -> int | None:
        """Value of an object that refused another, if it can be read."""
        variable = _variable(index, subindex)
        try:
            data = self._node.sdo.upload(index, subindex)
        except SdoAbortedError:
            return None  # the refusal of the write is the one to tell of
        except SdoCommunicationError as error:
            raise self._silent("read", index, subindex, error) from error
        return int(variable.decode_raw(data)) if len(data) * 8 == len(variable) else None

    def _request(self, command: int, index: int, value: int) -> None:
        self.network.send_message(identifiers.SDO_RX + self.node_id, _REQUEST.pack(command, index, 0, value))

    def _on_heartbeat(self, _can_id: int, data: bytearray, _timestamp: float) -> None:
        if bytes(data) == bytes((identifiers.HEARTBEAT_BOOT_UP,)):
            self.boot_ups += 1
        else:
            self.heartbeats += 1

    def _on_answer(self, _can_id: int, _data: bytearray, _timestamp: float) -> None:
        self.answers += 1

    def _silent(self, verb: str, index: int, subindex: int, error: SdoCommunicationError) -> BootError:
        return BootError(
            f"{self.where}: SDO {verb} of 0x{index:04X}:{subindex} failed ({error}; waited {SDO_TIMEOUT_S:g} s);"
            " check the drive's power and the bus"
        )


@lru_cache(maxsize=1)
def _dictionary() -> ObjectDictionary:
    dictionary = canopen.import_od(objects.eds_path())
    window = ODVariable("Synchronous window length", SYNC_WINDOW_US)
    window.data_type = datatypes.UNSIGNED32
    dictionary.add_object(window)
    return dictionary


def _variable(index: int, subindex: int) -> ODVariable:
    # All PDO records of a kind have the types of the first: CiA 301 sections 7.5.2.35 to 7.5.2.38.
    is_pdo_record = objects.RPDO_COMMUNICATION <= index < PDO_RECORDS_END
    variable = _dictionary().get_variable(index & ~0x1FF if is_pdo_record else index, subindex)
    if variable is None:
        raise BootError(f"object 0x{index:04X}:{subindex} is not in the profile's EDS file")
    return variable
