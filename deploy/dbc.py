"""`cosim bus --dbc`: a DBC file of a bus, for cantools, SavvyCAN, Wireshark and others.

Signals have the units of `RobotState`: gear, encoder, direction and zero offset are in factor and offset. What DBC
cannot say: the x torque of a force/torque sensor crosses two frames, so it is two signals whose sum it is. PDOs stand
as the HAL's boot maps them, which is what the drive's EDS file presets for the kind `torque`.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from typing import Final

from cantools.database import Database
from cantools.database.can import Message, Node
from cantools.database.can import Signal as DbcSignal
from cantools.database.conversion import BaseConversion
from cantools.database.namedsignalvalue import NamedSignalValue

from deploy.bus_layout import ALL, HAL, FrameLayout, Signal, bus_layouts
from schemas.robot import RobotDescription

UNITS: Final = {"N·m": "Nm", "m/s²": "m/s^2"}
"""DBC has no encoding of its own; units are kept to ASCII."""
_ILLEGAL: Final = re.compile(r"[^A-Za-z0-9_]+")


def dbc_text(robot: RobotDescription, bus: str) -> str:
    """DBC of one bus: nodes are the HAL, joints and sensors; messages are named `<node>_<object>`."""
    return dbc_database(robot, bus).as_dbc_string(sort_signals=None)


def dbc_database(robot: RobotDescription, bus: str) -> Database:
    """Make the same as a cantools database."""
    layouts = bus_layouts(robot, bus)
    names = _node_names(layouts)
    nodes = [Node(name, comment=None if owner == HAL else f"{owner} of {robot.name}") for owner, name in names.items()]
    return Database(
        messages=[_message(layout, names, robot.period_s) for layout in layouts], nodes=nodes, version=robot.name
    )


def identifier(text: str) -> str:
    """Turn a name into a C identifier, as DBC wants it."""
    name = _ILLEGAL.sub("_", text).strip("_") or "_"
    return f"_{name}" if name[0].isdigit() else name


def _node_names(layouts: tuple[FrameLayout, ...]) -> dict[str, str]:
    """DBC names of the owners, made distinct where characters that DBC lacks were all that told them apart."""
    names = {HAL: HAL}
    for layout in layouts:
        if layout.owner in names or layout.owner == ALL:
            continue
        stem = name = identifier(layout.owner)
        number = 1
        while name in names.values():
            number += 1
            name = f"{stem}_{number}"
        names[layout.owner] = name
    return names


def _message(layout: FrameLayout, names: dict[str, str], period_s: float) -> Message:
    owner = names.get(layout.owner)
    what = identifier(layout.what.replace("/", ""))
    receivers = [owner or name for name in ([HAL] if owner is None else [owner])] if layout.from_hal else [HAL]
    if layout.owner in (ALL, HAL):
        receivers = [name for name in names.values() if name != HAL]
    sender = HAL if layout.from_hal or owner is None else owner
    return Message(
        frame_id=layout.can_id,
        name=what if owner is None else f"{owner}_{what}",
        length=layout.length,
        signals=[_signal(signal, receivers) for signal in layout.signals],
        senders=[sender],
        cycle_time=_milliseconds(period_s) if layout.cyclic else None,
        comment=layout.comment or None,
    )


def _milliseconds(period_s: float) -> int | None:
    """DBC's cycle time is whole milliseconds; None where the period is not."""
    milliseconds = round(period_s * 1e3)
    return milliseconds if abs(milliseconds - period_s * 1e3) < 1e-9 else None


def _signal(signal: Signal, receivers: list[str]) -> DbcSignal:
    choices: OrderedDict[int, str | NamedSignalValue] = OrderedDict(
        (raw, NamedSignalValue(raw, name)) for raw, name in signal.choices.items()
    )
    scale = int(signal.scale) if signal.scale == 1.0 else signal.scale
    offset = int(signal.offset) if signal.offset == 0.0 else signal.offset
    return DbcSignal(
        name=signal.name,
        # A big-endian signal is named by its highest bit.
        start=signal.start + 7 if signal.big_endian else signal.start,
        length=signal.bits,
        byte_order="big_endian" if signal.big_endian else "little_endian",
        is_signed=signal.signed,
        conversion=BaseConversion.factory(scale=scale, offset=offset, choices=choices or None),
        unit=UNITS.get(signal.unit, signal.unit) or None,
        receivers=receivers,
    )
