"""Device-side object dictionary: entries from an EDS file, values of one device, access with SDO abort codes.

Keys of `values`, `on_read` and `on_write` are ``index << 8 | subindex``; see `key_of`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Any

from canopen import import_od
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from plant_service.errors import PlantError

Value = int | float | bytes
"""Numbers as numbers; strings and domains as bytes."""


class AbortCode(IntEnum):
    """SDO abort codes, CiA 301 table 22."""

    TOGGLE_NOT_ALTERNATED = 0x0503_0000
    UNKNOWN_COMMAND = 0x0504_0001
    UNSUPPORTED_ACCESS = 0x0601_0000
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    MAPPING_TOO_LONG = 0x0604_0042
    PARAMETER_INCOMPATIBLE = 0x0604_0043
    LENGTH_MISMATCH = 0x0607_0010
    LENGTH_TOO_HIGH = 0x0607_0012
    LENGTH_TOO_LOW = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    VALUE_INVALID = 0x0609_0030
    VALUE_TOO_HIGH = 0x0609_0031
    VALUE_TOO_LOW = 0x0609_0032
    GENERAL_ERROR = 0x0800_0000
    DEVICE_STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


class SdoAbort(PlantError):  # noqa: N818 - the name of the standard
    """An access that the device refuses with an abort code."""

    def __init__(self, code: AbortCode, index: int, subindex: int) -> None:
        name = code.name.lower().replace("_", " ")
        super().__init__(f"object 0x{index:04X}:{subindex:02X} refused: {name} (SDO abort 0x{code:08X})")
        self.code = code
        self.index = index
        self.subindex = subindex


@dataclass(frozen=True, slots=True)
class Entry:
    """What the EDS says of one object or sub-object."""

    index: int
    subindex: int
    access: str
    """`ro`, `rw`, `wo`, `const`, `rwr` (readable by TPDO), `rww` (writable by RPDO)."""
    codec: struct.Struct | None
    """None for strings and domains."""
    minimum: int | None
    maximum: int | None
    default: Value
    mappable: bool

    @property
    def readable(self) -> bool:
        """SDO upload allowed."""
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        """SDO download allowed."""
        return "w" in self.access

    @property
    def bits(self) -> int:
        """Length as a PDO mapping counts it; 0 for what has no fixed length."""
        return self.codec.size * 8 if self.codec else 0

    def abort(self, code: AbortCode) -> SdoAbort:
        """Build the abort with this entry's address."""
        return SdoAbort(code, self.index, self.subindex)


def key_of(index: int, subindex: int = 0) -> int:
    """Key of a value: ``index << 8 | subindex``, also the upper 24 bits of a PDO mapping entry."""
    return index << 8 | subindex


class DeviceDictionary:
    """The object dictionary of one device.

    `values` is open to the device itself, which may set what a master may only read. `on_read[key]()` gives a live
    value; `on_write[key](value)` runs before a value is stored and refuses it by raising `SdoAbort`; `written[key]`
    runs after.
    """

    def __init__(self, eds: Path, node_id: int) -> None:
        self.entries = load_entries(eds, node_id)
        self.subindices = {entry.index for entry in self.entries.values()}
        self.values: dict[int, Any] = {key: entry.default for key, entry in self.entries.items()}
        self.on_read: dict[int, Callable[[], Value]] = {}
        self.on_write: dict[int, Callable[[Any], None]] = {}
        self.written: dict[int, Callable[[Any], None]] = {}

    def reset(self, first: int = 0x1000, last: int = 0xFFFF) -> None:
        """Take the EDS's defaults for the objects from `first` to `last`: a node or communication reset."""
        for key, entry in self.entries.items():
            if first <= entry.index <= last:
                self.values[key] = entry.default

    def entry(self, index: int, subindex: int) -> Entry:
        """Entry at an address.

        Raises:
            SdoAbort: no such object, or no such sub-index.

        """
        entry = self.entries.get(index << 8 | subindex)
        if entry is None:
            code = AbortCode.NO_SUBINDEX if index in self.subindices else AbortCode.NO_OBJECT
            raise SdoAbort(code, index, subindex)
        return entry

    def read(self, index: int, subindex: int) -> bytes:
        """Encode a value for an SDO upload.

        Raises:
            SdoAbort: no such object, or write-only.

        """
        entry = self.entry(index, subindex)
        if not entry.readable:
            raise entry.abort(AbortCode.WRITE_ONLY)
        key = key_of(index, subindex)
        live = self.on_read.get(key)
        value: Any = live() if live else self.values[key]
        data: bytes = entry.codec.pack(value) if entry.codec else value
        return data

    def check_writable(self, index: int, subindex: int, length: int | None) -> Entry:
        """Refuse a download by its address and its length (None: not known yet).

        Raises:
            SdoAbort: no such object, read-only, or the wrong length.

        """
        entry = self.entry(index, subindex)
        if not entry.writable:
            raise entry.abort(AbortCode.READ_ONLY)
        if entry.codec and length is not None and length != entry.codec.size:
            too_long = length > entry.codec.size
            raise entry.abort(AbortCode.LENGTH_TOO_HIGH if too_long else AbortCode.LENGTH_TOO_LOW)
        return entry

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Decode, check, store: an SDO download.

        Raises:
            SdoAbort: no such object, read-only, wrong length, out of the EDS's limits, or refused by the device.

        """
        entry = self.check_writable(index, subindex, len(data))
        value: Value = entry.codec.unpack(data)[0] if entry.codec else bytes(data)
        if entry.maximum is not None and not isinstance(value, bytes) and value > entry.maximum:
            raise entry.abort(AbortCode.VALUE_TOO_HIGH)
        if entry.minimum is not None and not isinstance(value, bytes) and value < entry.minimum:
            raise entry.abort(AbortCode.VALUE_TOO_LOW)
        key = key_of(index, subindex)
        check = self.on_write.get(key)
        if check:
            check(value)
        self.values[key] = value
        done = self.written.get(key)
        if done:
            done(value)


@lru_cache(maxsize=512)
def load_entries(eds: Path, node_id: int) -> dict[int, Entry]:
    """Entries of an EDS file for a node, in ascending order; shared between devices, so never to be changed."""
    entries: dict[int, Entry] = {}
    for item in import_od(str(eds), node_id).values():
        if isinstance(item, ODRecord | ODArray):
            variables: list[ODVariable] = list(item.subindices.values())
        else:
            variables = [item]
        for variable in variables:
            if variable.index >= 0x1000:
                entries[key_of(variable.index, variable.subindex)] = _entry(variable)
    return dict(sorted(entries.items()))


def _entry(variable: ODVariable) -> Entry:
    codec = variable.STRUCT_TYPES.get(variable.data_type) if variable.data_type else None
    default: Any = variable.value if variable.value is not None else variable.default
    if codec is None:
        default = default.encode("ascii") if isinstance(default, str) else bytes(default or b"")
    elif variable.data_type in datatypes.FLOAT_TYPES:
        default = float(default or 0.0)
    else:
        default = int(default or 0)
    if codec is not None and not codec.format.startswith(("<", ">")):
        codec = struct.Struct("<" + codec.format)
    return Entry(
        index=variable.index,
        subindex=variable.subindex,
        access=variable.access_type,
        codec=codec,
        minimum=variable.min,
        maximum=variable.max,
        default=default,
        mappable=variable.pdo_mappable,
    )
