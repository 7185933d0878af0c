"""SDO server: expedited and segmented transfers between a master and one device's object dictionary.

CiA 301 section 7.2.4. A request and its answer are 8 bytes; byte 0 is the command, 1-3 the address (little endian).
Block transfers are refused. A block upload is answered by an ordinary upload where the client allows that by its
protocol switch threshold.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from plant_service.object_dictionary import AbortCode, DeviceDictionary, SdoAbort

ADDRESS = struct.Struct("<BHB")
DOWNLOAD_SEGMENT, DOWNLOAD, UPLOAD, UPLOAD_SEGMENT, ABORT, BLOCK_UPLOAD, BLOCK_DOWNLOAD = range(7)
"""Client command specifiers: the upper 3 bits of byte 0."""
EXPEDITED = 0x02
SIZE_GIVEN = 0x01
TOGGLE = 0x10
LAST_SEGMENT = 0x01
MAXIMUM_DOWNLOAD = 4096
"""No object of a drive is longer; more is refused instead of stored."""


@dataclass(slots=True)
class Transfer:
    """A segmented transfer under way."""

    index: int
    subindex: int
    upload: bool
    announced: int | None
    """Length the client announced for a download."""
    data: bytearray = field(default_factory=bytearray)
    """What is still to be sent, or what has arrived."""
    toggle: int = 0


class SdoServer:
    """Answers the requests of one client."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        self.dictionary = dictionary
        self._transfer: Transfer | None = None

    def reset(self) -> None:
        """Forget a transfer under way."""
        self._transfer = None

    def request(self, data: bytes) -> bytes | None:
        """Answer to a request of 8 bytes; None where the standard wants silence (an abort, or a wrong length)."""
        if len(data) != 8:
            return None
        command, index, subindex = ADDRESS.unpack_from(data)
        specifier = command >> 5
        if specifier == ABORT:
            self._transfer = None
            return None
        try:
            if specifier in (DOWNLOAD_SEGMENT, UPLOAD_SEGMENT):
                return self._segment(specifier, command, data)
            self._transfer = None
            if specifier == DOWNLOAD:
                return self._download(command, index, subindex, data)
            if specifier == UPLOAD:
                return self._upload(index, subindex)
            if specifier == BLOCK_UPLOAD and not command & 3:
                return self._block_upload(index, subindex, data[5])
            raise SdoAbort(AbortCode.UNKNOWN_COMMAND, index, subindex)
        except SdoAbort as abort:
            self._transfer = None
            return ADDRESS.pack(0x80, abort.index, abort.subindex) + struct.pack("<I", abort.code)

    def _block_upload(self, index: int, subindex: int, threshold: int) -> bytes:
        if len(self.dictionary.read(index, subindex)) > threshold:
            raise SdoAbort(AbortCode.UNKNOWN_COMMAND, index, subindex)
        return self._upload(index, subindex)

    def _upload(self, index: int, subindex: int) -> bytes:
        value = self.dictionary.read(index, subindex)
        size = len(value)
        if size == 0:
            raise SdoAbort(AbortCode.NO_DATA, index, subindex)
        if size <= 4:
            command = 0x40 | (4 - size) << 2 | EXPEDITED | SIZE_GIVEN
            return ADDRESS.pack(command, index, subindex) + value.ljust(4, b"\0")
        self._transfer = Transfer(index, subindex, upload=True, announced=None, data=bytearray(value))
        return ADDRESS.pack(0x40 | SIZE_GIVEN, index, subindex) + struct.pack("<I", size)

    def _download(self, command: int, index: int, subindex: int, data: bytes) -> bytes:
        if command & EXPEDITED:
            if command & SIZE_GIVEN:
                size = 4 - (command >> 2 & 3)
            else:  # the client leaves the length to the object
                codec = self.dictionary.entry(index, subindex).codec
                size = min(4, codec.size) if codec else 4
            self.dictionary.write(index, subindex, data[4 : 4 + size])
        else:
            announced = int.from_bytes(data[4:8], "little") if command & SIZE_GIVEN else None
            self.dictionary.check_writable(index, subindex, announced)
            if announced is not None and announced > MAXIMUM_DOWNLOAD:
                raise SdoAbort(AbortCode.LENGTH_TOO_HIGH, index, subindex)
            self._transfer = Transfer(index, subindex, upload=False, announced=announced)
        return ADDRESS.pack(0x60, index, subindex) + bytes(4)

    def _segment(self, specifier: int, command: int, data: bytes) -> bytes:
        transfer = self._transfer
        if transfer is None or transfer.upload != (specifier == UPLOAD_SEGMENT):
            address = (transfer.index, transfer.subindex) if transfer else (0, 0)
            raise SdoAbort(AbortCode.UNKNOWN_COMMAND, *address)
        if command & TOGGLE != transfer.toggle:
            raise SdoAbort(AbortCode.TOGGLE_NOT_ALTERNATED, transfer.index, transfer.subindex)
        toggle, transfer.toggle = transfer.toggle, transfer.toggle ^ TOGGLE
        if transfer.upload:
            return self._upload_segment(transfer, toggle)
        return self._download_segment(transfer, toggle, command, data)

    def _upload_segment(self, transfer: Transfer, toggle: int) -> bytes:
        part = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = 0 if transfer.data else LAST_SEGMENT
        if last:
            self._transfer = None
        return bytes([toggle | (7 - len(part)) << 1 | last]) + part.ljust(7, b"\0")

    def _download_segment(self, transfer: Transfer, toggle: int, command: int, data: bytes) -> bytes:
        transfer.data += data[1 : 8 - (command >> 1 & 7)]
        address = (transfer.index, transfer.subindex)
        limit = MAXIMUM_DOWNLOAD if transfer.announced is None else transfer.announced
        if len(transfer.data) > limit:
            raise SdoAbort(AbortCode.LENGTH_TOO_HIGH, *address)
        if command & LAST_SEGMENT:
            if transfer.announced is not None and len(transfer.data) < transfer.announced:
                raise SdoAbort(AbortCode.LENGTH_TOO_LOW, *address)
            self._transfer = None
            self.dictionary.write(*address, bytes(transfer.data))
        return bytes([0x20 | toggle]) + bytes(7)
