"""Object dictionary and PDO records of the foreign slave, written from CiA 301 and CiA 402 alone."""

from __future__ import annotations

from dataclasses import dataclass, field

TOGGLE, COMMAND = 0x05030000, 0x05040001
UNSUPPORTED, READ_ONLY, NO_OBJECT, NOT_MAPPABLE, PDO_TOO_LONG = (
    0x06010000,
    0x06010002,
    0x06020000,
    0x06040041,
    0x06040042,
)
LENGTH, NO_SUBINDEX, VALUE, GENERAL = 0x06070010, 0x06090011, 0x06090030, 0x08000000
INVALID = 1 << 31


class Abort(Exception):  # noqa: N818 - the standard's word
    """An SDO abort."""

    def __init__(self, code: int) -> None:
        super().__init__(f"0x{code:08X}")
        self.code = code


@dataclass(slots=True)
class Item:
    """One object: its length [bytes], value and access."""

    size: int
    value: int = 0
    access: str = "rw"
    signed: bool = False
    mappable: bool = False


@dataclass(frozen=True, slots=True)
class Habits:
    """What a maker does differently; the defaults are those of a friendly drive."""

    vendor_id: int = 0x1234
    product_code: int = 7
    device_type: int = 0x00020192
    supported_modes: int = 0x280
    position: int = 0
    objects: dict[tuple[int, int], Item] = field(default_factory=dict)
    """Objects that differ from the usual ones."""
    lacks: frozenset[int] = frozenset()
    """Indices of objects that do not exist."""
    refused: dict[tuple[int, int], int] = field(default_factory=dict)
    """Abort code of every write to these."""
    ignored: frozenset[int] = frozenset()
    """Indices whose writes are confirmed and forgotten."""
    types: frozenset[int] = frozenset(range(241)) | {254, 255}
    """Transmission types that it takes."""
    pdo_records: int = 4
    boots: bool = True
    """Sends a boot-up message."""
    beats: bool = True
    """Sends heartbeats."""
    answers: bool = True
    """Answers SDO requests."""
    starts_itself: bool = False
    """Goes to OPERATIONAL after its boot-up message, as CiA 302-2 lets a slave do without object 0x1F80."""
    samples_first: bool = False
    """Sends the TPDOs of a SYNC before it takes the RPDOs that came before the SYNC."""
    tells_changes: bool = True
    """Sends TPDOs of type 0 at all: some stacks leave it to the application to say what has changed."""
    obeys: str = "any"
    """`any` controlword, those of `pdo`s only, or any but at a `sync` only."""
    mode_when: str = "at once"
    """When 0x6061 follows 0x6060: `at once`, once `enabled`, `sync`, or `never`."""
    power: int = 0x40
    """State after power-on, as in the statusword."""
    lag: int = 0
    """Reads of the statusword after which it tells of a new state."""
    reset_s: float = 0.0
    """Time for a reset."""
    answer_s: float = 0.0
    """Time for an SDO answer."""
    faults: int = 0
    """Fault resets that it takes to leave FAULT, in which it starts if there are any; −1: nothing helps."""


def lely_like(**changes: object) -> Habits:
    """A generic stack with a dictionary: what CiA 301 asks for, and the objects of CiA 402 as plain entries."""
    habits: dict[str, object] = {
        "vendor_id": 0x360,
        "product_code": 1,
        "lacks": frozenset({0x1006, 0x60C2, 0x6007, 0x6072, 0x6076}),
        "starts_itself": True,
        "samples_first": True,
        "tells_changes": False,
    }
    return Habits(**(habits | changes))  # type: ignore[arg-type]  # fields by name


def usual_objects(node: int, habits: Habits) -> dict[tuple[int, int], Item]:
    """Objects of a CiA 402 drive after power-on."""
    status = 0x08 if habits.faults else habits.power
    items = {
        (0x1000, 0): Item(4, habits.device_type, "ro"),
        (0x1001, 0): Item(1, 0, "ro"),
        (0x1005, 0): Item(4, 0x80),
        (0x1006, 0): Item(4),
        (0x1016, 0): Item(1, 2, "ro"),
        (0x1016, 1): Item(4),
        (0x1016, 2): Item(4),
        (0x1017, 0): Item(2),
        (0x1018, 0): Item(1, 4, "ro"),
        (0x1018, 1): Item(4, habits.vendor_id, "ro"),
        (0x1018, 2): Item(4, habits.product_code, "ro"),
        (0x6007, 0): Item(2, 1, signed=True),
        (0x603F, 0): Item(2, 0x7305 if habits.faults else 0, "ro", mappable=True),
        (0x6040, 0): Item(2, mappable=True),
        (0x6041, 0): Item(2, status, "ro", mappable=True),
        (0x6060, 0): Item(1, signed=True, mappable=True),
        (0x6061, 0): Item(1, 0, "ro", signed=True, mappable=True),
        (0x6064, 0): Item(4, habits.position, "ro", signed=True, mappable=True),
        (0x6071, 0): Item(2, signed=True, mappable=True),
        (0x6072, 0): Item(2, 1000, mappable=True),
        (0x6076, 0): Item(4, 1000),
        (0x6077, 0): Item(2, 0, "ro", signed=True, mappable=True),
        (0x607A, 0): Item(4, signed=True, mappable=True),
        (0x60C2, 0): Item(1, 2, "ro"),
        (0x60C2, 1): Item(1, 1),
        (0x60C2, 2): Item(1, -3, signed=True),
        (0x6502, 0): Item(4, habits.supported_modes, "ro"),
    }
    received = ((0x60400010,), (0x60400010, 0x60600008), (0x60400010, 0x607A0020), (0x60400010, 0x60710010))
    sent = ((0x60410010,), (0x60410010, 0x60610008), (0x60410010, 0x60640020), (0x60410010, 0x60770010))
    for number in range(habits.pdo_records):
        for communication, first, presets in ((0x1400, 0x200, received), (0x1800, 0x40000180, sent)):
            record, mapping = communication + number, communication + 0x200 + number
            items[record, 0] = Item(1, 2, "ro")
            items[record, 1] = Item(4, first + 0x100 * number + node)
            items[record, 2] = Item(1, 255)
            items[mapping, 0] = Item(1, len(presets[number]))
            for subindex in range(1, 9):
                entry = presets[number][subindex - 1] if subindex <= len(presets[number]) else 0
                items[mapping, subindex] = Item(4, entry)
    items |= habits.objects
    return {address: item for address, item in items.items() if address[0] not in habits.lacks}


class Dictionary:
    """The objects of one slave, with the standard's rules for changing PDOs."""

    def __init__(self, node: int, habits: Habits) -> None:
        self._node = node
        self._habits = habits
        self.items: dict[tuple[int, int], Item] = {}
        self.reset(0xFFFF)

    def reset(self, last: int) -> None:
        """Take the power-on values of the objects up to an index."""
        fresh = usual_objects(self._node, self._habits)
        self.items |= {address: item for address, item in fresh.items() if address[0] <= last}

    def __getitem__(self, address: tuple[int, int]) -> int:
        """Value of an object, 0 where it does not exist."""
        item = self.items.get(address)
        return 0 if item is None else item.value

    def __setitem__(self, address: tuple[int, int], value: int) -> None:
        """Set an object where it exists."""
        if address in self.items:
            self.items[address].value = value

    def upload(self, index: int, subindex: int) -> bytes:
        item = self._item(index, subindex)
        return item.value.to_bytes(item.size, "little", signed=item.signed)

    def download(self, index: int, subindex: int, data: bytes) -> bool:
        """Store a value; whether it is to act."""
        item = self._item(index, subindex)
        if (index, subindex) in self._habits.refused:
            raise Abort(self._habits.refused[index, subindex])
        if item.access == "ro":
            raise Abort(READ_ONLY)
        if len(data) != item.size:
            raise Abort(LENGTH)
        if index in self._habits.ignored:
            return False
        value = int.from_bytes(data, "little", signed=item.signed)
        if 0x1400 <= index < 0x1C00:
            self._check_pdo(index, subindex, value)
        item.value = value
        return True

    def pdo(self, communication: int) -> tuple[int, int, list[tuple[int, int]]] | None:
        """CAN identifier, type and mapped objects of a valid PDO."""
        if (communication, 1) not in self.items or self[communication, 1] & INVALID:
            return None
        mapping = communication + 0x200
        entries = [self[mapping, number] for number in range(1, self[mapping, 0] + 1)]
        mapped = [(entry >> 16, entry >> 8 & 0xFF) for entry in entries]
        return self[communication, 1] & 0x7FF, self[communication, 2], mapped

    def _item(self, index: int, subindex: int) -> Item:
        if (index, subindex) not in self.items:
            raise Abort(NO_SUBINDEX if any(index == known for known, _ in self.items) else NO_OBJECT)
        return self.items[index, subindex]

    def _check_pdo(self, index: int, subindex: int, value: int) -> None:
        """CiA 301 sections 7.5.2.35 to 7.5.2.38."""
        if not index & 0x200:
            held = self[index, 1]
            if subindex == 1 and not held & INVALID and (held ^ value) & 0x3FFFFFFF:
                raise Abort(VALUE)  # an identifier may not change while the PDO is valid
            if subindex == 2 and value not in self._habits.types:
                raise Abort(VALUE)
            return
        if value == self[index, subindex]:
            return
        communication = index - 0x200
        if not self[communication, 1] & INVALID or (subindex and self[index, 0]):
            raise Abort(UNSUPPORTED)
        if not subindex:
            if sum(self[index, number] & 0xFF for number in range(1, value + 1)) > 64:
                raise Abort(PDO_TOO_LONG)
            return
        mapped = self.items.get((value >> 16, value >> 8 & 0xFF))
        if mapped is None:
            raise Abort(NO_OBJECT)
        if not mapped.mappable or mapped.size * 8 != value & 0xFF or (index < 0x1800 and mapped.access == "ro"):
            raise Abort(NOT_MAPPABLE)
