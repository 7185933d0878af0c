"""The `canopen` library's SDO client and network over a `FramePort`: no threads, every frame passes the port.

The network is fed from the port while somebody waits, so the frames of a boot depend on the drives' answers alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Final, cast

import canopen
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from canopen.sdo.client import SdoClient

from hal.bus.ports import FramePort
from hal.errors import BootError
from hal.profile import objects
from hal.profile.frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, pack, unpack

SDO_TIMEOUT_S = 3.0
"""Wait for one SDO answer; a request is never repeated, so that logs of equal runs are equal."""
SYNC_WINDOW_US: Final = 0x1007
PDO_RECORDS_END = 0x1C00
SDO_REQUEST: Final = Struct("<BHBI")
"""Command, index, sub-index, 4 bytes of data: an expedited transfer, CiA 301 section 7.2.4.3."""
_NOT_FOR_CANOPEN = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG
_ABORT: Final = 0x80
_INITIATES: Final = (1, 2)
"""Client command specifiers of requests that begin a download or an upload."""
_WITH_ADDRESS: Final = (2, 3, 4)
"""Server command specifiers of answers with index and sub-index: to these, and aborts."""
_NO_ADDRESS: Final = bytes(3)
"""In the abort of a server that has no transfer under way."""
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


class PumpedSdoClient(SdoClient):
    """Client of one drive's default SDO channel."""

    RESPONSE_TIMEOUT = 0.001
    MAX_RETRIES = 1
    """Attempts altogether, in the library's counting."""

    def __init__(self, rx_cobid: int, tx_cobid: int, dictionary: ObjectDictionary) -> None:
        super().__init__(rx_cobid, tx_cobid, dictionary)  # type: ignore[no-untyped-call]  # the library is untyped
        self.requests = 0
        """Transfers begun."""
        self.echoes = 0
        """Answers to a request that was answered before."""
        self._asked = b""
        """Index and sub-index of the transfer under way."""
        self._waits = False
        self._ever_asked: set[bytes] = set()

    def send_request(self, request: bytes) -> None:
        """Send a request and note what it is about."""
        if request[0] >> 5 in _INITIATES:
            self.requests += 1
            self._asked, self._waits = bytes(request[1:4]), True
            self._ever_asked.add(self._asked)
        super().send_request(request)  # type: ignore[no-untyped-call]  # as above

    def on_response(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Take an answer; pass over those to others, and to requests that are over."""
        if data and data[0] >> 5 in _WITH_ADDRESS:
            address = bytes(data[1:4])
            if not (self._waits and address == self._asked):
                self.echoes += address in self._ever_asked
                if address not in (self._asked, _NO_ADDRESS):
                    return
            self._waits = False
        super().on_response(can_id, data, timestamp)  # type: ignore[no-untyped-call]  # as above

    def read_response(self) -> bytes:
        """Wait for an answer, feeding all services of the network meanwhile."""
        network = cast(PortNetwork, self.network)
        network.wait_until(lambda: not self.responses.empty(), SDO_TIMEOUT_S)
        return cast(bytes, super().read_response())  # type: ignore[no-untyped-call]  # as above

    def abort(self, abort_code: int = _GENERAL_ERROR) -> None:
        """Abort the transfer; unlike the library's, nothing is printed: whoever waited for it tells of it."""
        self.send_request(SDO_REQUEST.pack(_ABORT, 0, 0, abort_code))

    def upload(self, index: int, subindex: int) -> bytes:
        """Read an object; unlike the library's, data of another length than the dictionary's are not cut to fit."""
        with self.open(index, subindex, buffering=0) as stream:  # type: ignore[no-untyped-call]  # as above
            data = cast(bytes, stream.read())
            size_given = stream.size is not None
        return data if size_given else data[: len(profile_variable(index, subindex)) // 8]


class PumpedNode(canopen.RemoteNode):
    """A remote node whose SDO clients pump."""

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> SdoClient:
        """Add a client; as the library's, for its own class."""
        client = PumpedSdoClient(rx_cobid, tx_cobid, self.object_dictionary)
        self.sdo_channels.append(client)
        if self.has_network():
            self.network.subscribe(tx_cobid, client.on_response)
        return client


@lru_cache(maxsize=1)
def profile_dictionary() -> ObjectDictionary:
    """Read the objects of the profile's EDS file, once."""
    dictionary = canopen.import_od(objects.eds_path())
    window = ODVariable("Synchronous window length", SYNC_WINDOW_US)
    window.data_type = datatypes.UNSIGNED32
    dictionary.add_object(window)
    return dictionary


def profile_variable(index: int, subindex: int) -> ODVariable:
    """Type of one object.

    Raises:
        BootError: the EDS does not have it.

    """
    # All PDO records of a kind have the types of the first: CiA 301 sections 7.5.2.35 to 7.5.2.38.
    is_pdo_record = objects.RPDO_COMMUNICATION <= index < PDO_RECORDS_END
    variable = profile_dictionary().get_variable(index & ~0x1FF if is_pdo_record else index, subindex)
    if variable is None:
        raise BootError(f"object 0x{index:04X}:{subindex} is not in the profile's EDS file")
    return variable
