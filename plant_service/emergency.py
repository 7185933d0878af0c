"""EMCY producer: active errors, the error register 0x1001, the history 0x1003 and the code 0x603F, kept in step.

CiA 301 section 7.2.7. An error is reported once when it appears and once, with code 0, when it goes.
"""

from __future__ import annotations

from functools import partial
from typing import Final

from hal.profile import frames
from hal.profile.cia402 import EmergencyCode, ErrorRegister
from hal.profile.identifiers import COB_ID_INVALID
from hal.profile.objects import EMCY_COB_ID, EMCY_STRUCT, ERROR_CODE, ERROR_HISTORY, ERROR_REGISTER
from plant_service.object_dictionary import AbortCode, DeviceDictionary, key_of
from plant_service.pdo import CAN_ID_BITS, check_can_id

HISTORY_LENGTH: Final = 8
COUNT: Final = key_of(ERROR_HISTORY, 0)

REGISTER_OF_CLASS: Final = {
    0x2: ErrorRegister.CURRENT,
    0x3: ErrorRegister.VOLTAGE,
    0x4: ErrorRegister.TEMPERATURE,
    0x7: ErrorRegister.PROFILE,
    0x8: ErrorRegister.COMMUNICATION,
    0xF: ErrorRegister.MANUFACTURER,
}
"""Upper 4 bits of an error code → bit of the error register, beside GENERIC which every error sets."""


def register_of(code: int) -> ErrorRegister:
    """Bits of 0x1001 that an error sets."""
    if code >> 8 == 0x86:  # following errors belong to monitoring, not to communication
        return ErrorRegister.GENERIC | ErrorRegister.PROFILE
    return ErrorRegister.GENERIC | REGISTER_OF_CLASS.get(code >> 12, ErrorRegister(0))


class Emergency:
    """Errors of one device; `frames` collects what is to be sent."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        self._dictionary = dictionary
        self._values = dictionary.values
        self.active: dict[int, ErrorRegister] = {}
        """Errors that are present: code → bits of the register."""
        self.frames: list[bytes] = []
        dictionary.on_write[COUNT] = self._clear_history
        dictionary.on_write[key_of(EMCY_COB_ID)] = self._check_cob_id
        for subindex in range(1, HISTORY_LENGTH + 1):
            dictionary.on_read[key_of(ERROR_HISTORY, subindex)] = partial(self._history, subindex)

    def appear(self, code: int) -> None:
        """Report an error, unless it is present already."""
        if code in self.active:
            return
        self.active[code] = register_of(code)
        self._remember(code)
        self._report(code)

    def vanish(self, *codes: int) -> None:
        """Take errors back: one "error reset" EMCY, with the register of what is left."""
        gone = [code for code in codes if code in self.active]
        for code in gone:
            del self.active[code]
        if gone:
            self._report(EmergencyCode.NO_ERROR)

    def restart(self, *, faulty: bool) -> None:
        """Start anew after the dictionary was reset, without a report.

        Args:
            faulty: the drive stays in fault, so its errors are still present and make up the history.

        """
        if not faulty:
            self.active.clear()
            self.frames.clear()
        for code in self.active:
            self._remember(code)
        self._update()

    def _remember(self, code: int) -> None:
        count = min(self._values[COUNT] + 1, HISTORY_LENGTH)
        for subindex in range(count, 1, -1):
            self._values[key_of(ERROR_HISTORY, subindex)] = self._values[key_of(ERROR_HISTORY, subindex - 1)]
        self._values[key_of(ERROR_HISTORY, 1)] = code
        self._values[COUNT] = count

    def _update(self) -> int:
        register = 0
        for bits in self.active.values():
            register |= bits
        self._values[key_of(ERROR_REGISTER)] = register
        self._values[key_of(ERROR_CODE)] = next(reversed(self.active), 0)
        return register

    def _report(self, code: int) -> None:
        register = self._update()
        cob_id = self._values[key_of(EMCY_COB_ID)]
        if not cob_id & COB_ID_INVALID:
            self.frames.append(frames.pack(cob_id & CAN_ID_BITS, EMCY_STRUCT.pack(code, register, bytes(5))))

    def _history(self, subindex: int) -> int:
        if subindex > self._values[COUNT]:
            raise self._dictionary.entries[key_of(ERROR_HISTORY, subindex)].abort(AbortCode.NO_DATA)
        return int(self._values[key_of(ERROR_HISTORY, subindex)])

    def _clear_history(self, value: int) -> None:
        if value != 0:
            raise self._dictionary.entries[COUNT].abort(AbortCode.VALUE_INVALID)
        for subindex in range(1, HISTORY_LENGTH + 1):
            self._values[key_of(ERROR_HISTORY, subindex)] = 0

    def _check_cob_id(self, value: int) -> None:
        entry = self._dictionary.entries[key_of(EMCY_COB_ID)]
        check_can_id(value, entry)
        now = self._values[key_of(EMCY_COB_ID)]
        if not (now | value) & COB_ID_INVALID and (now ^ value) & CAN_ID_BITS:
            raise entry.abort(AbortCode.VALUE_INVALID)
