"""A drive's PDOs: written in the standard's order, then read back, because only what a drive holds counts.

Some drives have fixed PDOs, some let only part of a record be written, some answer "yes" and keep their own. So a
refusal is no error by itself: what the record holds at the end is.
"""

from __future__ import annotations

from dataclasses import dataclass

from hal.boot_objects import PdoPlan
from hal.errors import BootError
from hal.node_link import NodeLink, Refusal
from hal.profile.identifiers import COB_ID_INVALID, COB_ID_NO_RTR

COB_ID, TYPE = 1, 2
"""Sub-indices of a communication record."""


@dataclass(frozen=True, slots=True)
class PdoRecord:
    """What a drive holds of one PDO."""

    cob_id: int
    transmission_type: int
    entries: tuple[int, ...]

    @property
    def size(self) -> int:
        """Data bytes."""
        return sum(entry & 0xFF for entry in self.entries) // 8


def set_up_pdo(link: NodeLink, plan: PdoPlan) -> str | None:
    """Give one PDO record its contents.

    Returns:
        What the drive did not take but can do without, or None.

    Raises:
        BootError: the PDO is missing, or holds something else in the end: both are told, with the drive's refusal.
        BusLostError: the bus is gone.

    """
    held = link.read_optional(plan.communication, COB_ID)
    if plan.pdo is None:
        if held is None or held & COB_ID_INVALID:
            return None
        refusal = link.try_write(plan.communication, COB_ID, held | COB_ID_INVALID)
        return None if refusal is None else f"{plan.name}, which is not used, stays valid: {refusal.text}"
    if held is None:
        raise BootError(
            f"{link.where}: the drive has no {plan.name} (object 0x{plan.communication:04X}), which the HAL needs"
        )
    refusals = _write(link, plan, held)
    difference = _difference(plan, _read(link, plan))
    if difference is not None:
        because = f"; {refusals[0].text}" if refusals else ""
        raise BootError(f"{link.where}: {difference}{because}")
    return None


def _write(link: NodeLink, plan: PdoPlan, held: int) -> list[Refusal]:
    """Follow the sequence of CiA 301 section 7.5.2.36: invalid, empty, entries, count, type, valid; what was refused.

    A PDO is made invalid with the identifier that it has: its other bits must not change while it is valid.
    """
    assert plan.pdo is not None
    refusals: list[Refusal] = []

    def taken(index: int, subindex: int, *values: int) -> bool:
        """Write the first of some values that the drive takes."""
        found = []
        for value in values:
            refusal = link.try_write(index, subindex, value)
            if refusal is None:
                return True
            found.append(refusal)
        refusals.append(found[0])
        return False

    entries = [(number, entry) for number, entry in enumerate(plan.pdo.entries, 1)]
    if not held & COB_ID_INVALID:
        taken(plan.communication, COB_ID, held | COB_ID_INVALID)
    if taken(plan.mapping, 0, 0) and all(taken(plan.mapping, *entry) for entry in entries):
        taken(plan.mapping, 0, len(entries))
    taken(plan.communication, TYPE, *plan.types)
    taken(plan.communication, COB_ID, plan.cob_id, plan.cob_id ^ COB_ID_NO_RTR)
    return refusals


def _read(link: NodeLink, plan: PdoPlan) -> PdoRecord:
    count = link.read(plan.mapping, 0)
    return PdoRecord(
        cob_id=link.read(plan.communication, COB_ID),
        transmission_type=link.read(plan.communication, TYPE),
        entries=tuple(link.read(plan.mapping, number) for number in range(1, count + 1)),
    )


def _difference(plan: PdoPlan, record: PdoRecord) -> str | None:
    """In what a record differs from its plan, in words."""
    pdo = plan.pdo
    assert pdo is not None
    if record.entries != pdo.entries:
        return (
            f"{plan.name} maps {record.size} bytes ({_listed(record.entries)}), must be {pdo.size}"
            f" ({_listed(pdo.entries)})"
        )
    if (record.cob_id ^ plan.cob_id) & ~COB_ID_NO_RTR:
        return f"{plan.name} has COB-ID 0x{record.cob_id:08X}, must be 0x{plan.cob_id:08X}"
    if record.transmission_type not in plan.types:
        types = " or ".join(map(str, plan.types))
        return f"{plan.name} has transmission type {record.transmission_type}, must be {types}"
    return None


def _listed(entries: tuple[int, ...]) -> str:
    return ", ".join(f"0x{entry:08X}" for entry in entries) or "no entries"
