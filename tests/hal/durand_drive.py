"""A CiA 402 drive on the `durand` device stack: a third party's SDO, NMT and PDOs, our power stage."""

from __future__ import annotations

from typing import Any

import can
import durand
from durand.datatypes import DatatypeEnum
from durand.node import NodeCapabilities
from durand.object_dictionary import ObjectDictionary
from durand.scheduler import VirtualScheduler

from hal.profile import cia402, objects
from hal.profile.cia402 import OperationMode, StatusBit
from schemas.messages import DriveState

UNSIGNED8, UNSIGNED16, UNSIGNED32 = DatatypeEnum.UNSIGNED8, DatatypeEnum.UNSIGNED16, DatatypeEnum.UNSIGNED32
INTEGER8, INTEGER16, INTEGER32 = DatatypeEnum.INTEGER8, DatatypeEnum.INTEGER16, DatatypeEnum.INTEGER32


class _Network(durand.CANBusNetwork):  # type: ignore[misc]  # the library is untyped
    def __init__(self, bus: can.BusABC) -> None:
        super().__init__(bus)
        # Its reader thread ends within this time of being stopped.
        self._notifier.timeout = 0.02


class DurandDrive:
    """One device on a python-can bus; in position mode it stands at once where it is told to."""

    def __init__(
        self,
        bus: can.BusABC,
        node_id: int,
        *,
        vendor_id: int = 0x1234,
        product_code: int = 7,
        supported_modes: int = cia402.SUPPORTED_MODES["torque"],
        position: int = 0,
        fault: bool = False,
        fault_stays: bool = False,
    ) -> None:
        durand.set_scheduler(VirtualScheduler())
        self.network = _Network(bus)
        self.fault_stays = fault_stays
        self.state = DriveState.FAULT if fault else DriveState.SWITCH_ON_DISABLED
        self.previous_controlword = 0
        self.controlwords: list[int] = []
        dictionary = ObjectDictionary()
        variables = [
            (objects.SYNC_PERIOD_US, UNSIGNED32, "rw", 0),
            (objects.ERROR_CODE, UNSIGNED16, "ro", 0x7320 if fault else 0),
            (objects.CONTROLWORD, UNSIGNED16, "rw", 0),
            (objects.STATUSWORD, UNSIGNED16, "ro", cia402.encode_statusword(self.state)),
            (objects.MODE, INTEGER8, "rw", 0),
            (objects.MODE_DISPLAY, INTEGER8, "ro", 0),
            (objects.POSITION_ACTUAL, INTEGER32, "ro", position),
            (objects.TARGET_TORQUE, INTEGER16, "rw", 0),
            (objects.MAX_TORQUE, UNSIGNED16, "rw", 1000),
            (objects.RATED_TORQUE_MNM, UNSIGNED32, "rw", 1000),
            (objects.TORQUE_ACTUAL, INTEGER16, "ro", 0),
            (objects.TARGET_POSITION, INTEGER32, "rw", 0),
            (objects.SUPPORTED_DRIVE_MODES, UNSIGNED32, "ro", supported_modes),
        ]
        for index, datatype, access, value in variables:
            dictionary[index] = durand.Variable(datatype, access, value)
        dictionary[objects.CONSUMER_HEARTBEAT] = durand.Array(durand.Variable(UNSIGNED32, "rw", 0), 1)
        self.node = durand.Node(self.network, node_id, dictionary, NodeCapabilities(1, 4, 4))
        dictionary.write(objects.IDENTITY, 1, vendor_id)
        dictionary.write(objects.IDENTITY, 2, product_code)
        dictionary.download_callbacks[(objects.CONTROLWORD, 0)].add(self._controlword)
        dictionary.download_callbacks[(objects.MODE, 0)].add(self._mode)
        dictionary.download_callbacks[(objects.TARGET_POSITION, 0)].add(self._follow)
        dictionary.download_callbacks[(objects.TARGET_TORQUE, 0)].add(self._torque)

    def read(self, index: int, subindex: int = 0) -> Any:
        return self.node.object_dictionary.read(index, subindex)

    def stop(self) -> None:
        self.network.stop()

    def _write(self, index: int, value: int) -> None:
        self.node.object_dictionary.write(index, 0, value)

    def _controlword(self, controlword: int) -> None:
        if controlword != self.previous_controlword:
            self.controlwords.append(controlword)
        state = cia402.next_state(self.state, controlword, self.previous_controlword)
        self.previous_controlword = controlword
        if self.state is DriveState.FAULT and self.fault_stays:
            state = DriveState.FAULT
        if state is not self.state:
            self.state = state
            enabled = state is DriveState.OPERATION_ENABLED
            bits = StatusBit.FOLLOWS_COMMAND if enabled else StatusBit(0)
            self._write(objects.STATUSWORD, cia402.encode_statusword(state, bits))

    def _mode(self, mode: int) -> None:
        self._write(objects.MODE_DISPLAY, mode)

    def _follow(self, position: int) -> None:
        if self.state is DriveState.OPERATION_ENABLED and self.read(objects.MODE) == OperationMode.CSP:
            self._write(objects.POSITION_ACTUAL, position)

    def _torque(self, per_mille: int) -> None:
        if self.state is DriveState.OPERATION_ENABLED and self.read(objects.MODE) == OperationMode.CST:
            self._write(objects.TORQUE_ACTUAL, per_mille)
