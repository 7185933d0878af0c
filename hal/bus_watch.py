"""State of each bus as its controller and its interface tell it: trouble, its end, and what it means for the robot."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

from hal.bus.error_frames import ErrorReport, Trouble
from hal.decode import Notice


class BusState(Enum):
    """What a bus is good for, the later the worse."""

    ACTIVE = 0
    PASSIVE = 1
    """Frames pass, but the controller counts 128 errors or more (ISO 11898-1)."""
    OFF = 2
    """The controller has taken itself off the bus."""
    DOWN = 3
    """The interface takes and gives nothing."""


_KIND = {BusState.PASSIVE: "bus_error_passive", BusState.OFF: "bus_off", BusState.DOWN: "bus_down"}
_ADVICE = {
    BusState.PASSIVE: "check wiring, termination and bit rate",
    BusState.OFF: "check for a short circuit; set restart-ms or `ip link set … type can restart`",
    BusState.DOWN: "",
}
_AGAIN = (Trouble.ERROR_ACTIVE, Trouble.ERROR_WARNING, Trouble.RESTARTED)
"""Each says that the controller is error-active: the warning level lies below the passive one."""
_LOST_FRAMES = (Trouble.RECEIVE_OVERFLOW, Trouble.TRANSMIT_OVERFLOW)
_PLAIN = (
    Trouble.ERROR_WARNING,
    Trouble.NO_ACKNOWLEDGE,
    Trouble.PROTOCOL,
    Trouble.TRANSCEIVER,
    Trouble.TRANSMIT_TIMEOUT,
    Trouble.BUS_ERROR,
    Trouble.CONTROLLER,
)
"""Worth a warning at their onset."""


class BusWatch:
    """Follows one bus, a cycle at a time; tells each finding once, at its onset.

    A bus in trouble is good again when its controller says so, its interface is up, or frames pass for some cycles
    without error frames. It has recovered when, after that, all its drives hold again by the HAL's command.
    """

    def __init__(self, name: str, patience: int) -> None:
        """Watch bus `name`; `patience` is the number of cycles without errors that end a trouble or a warning."""
        self.name = name
        self.state = BusState.ACTIVE
        self.recovering = False
        """There was trouble, and the drives have not yet been found to hold."""
        self._patience = patience
        self._warned: set[Trouble] = set()
        self._quiet = 0
        """Cycles with frames of the wire and without errors."""

    @property
    def troubled(self) -> bool:
        """The bus is in trouble, or not yet recovered from it."""
        return self.recovering or self.state is not BusState.ACTIVE

    @property
    def silent(self) -> bool:
        """No frames are to be expected."""
        return self.state in (BusState.OFF, BusState.DOWN)

    def review(self, errors: Iterable[ErrorReport], heard: bool, down: str | None) -> list[Notice]:
        """List the findings of one cycle.

        Args:
            errors: error frames, in their order.
            heard: frames of the wire came.
            down: why the interface takes and gives nothing; None: it is up.
        """
        notices: list[Notice] = []
        if down is not None:
            self._enter(BusState.DOWN, down, notices)
        elif self.state is BusState.DOWN:
            self._leave()
        faults = False
        for report in errors:
            faults |= any(trouble is not Trouble.LOST_ARBITRATION for trouble in report.troubles)
            self._hear(report, notices)
        self._quiet = 0 if faults else self._quiet + heard
        if self._quiet >= self._patience:
            self._warned.clear()
            if self.state in (BusState.PASSIVE, BusState.OFF):
                self._leave()
        return notices

    def recovered(self) -> Notice:
        """All drives of the bus hold again."""
        self.recovering = False
        return Notice("bus_recovered", "info", f"bus {self.name}: works again, and its drives report and hold")

    def _hear(self, report: ErrorReport, notices: list[Notice]) -> None:
        text = f"bus {self.name}: {report}"
        # Of two counters one may be past the passive level and the other past the warning level, in one frame.
        worse = not {Trouble.BUS_OFF, Trouble.ERROR_PASSIVE}.isdisjoint(report.troubles)
        for trouble in report.troubles:
            if trouble is Trouble.BUS_OFF:
                self._enter(BusState.OFF, f"{text}; {_ADVICE[BusState.OFF]}", notices)
            elif trouble is Trouble.ERROR_PASSIVE:
                self._enter(BusState.PASSIVE, f"{text}; {_ADVICE[BusState.PASSIVE]}", notices)
            elif trouble in _AGAIN and self.state in (BusState.PASSIVE, BusState.OFF) and not worse:
                self._leave()
            if trouble in self._warned:
                continue
            if trouble in _LOST_FRAMES:
                self._warned.add(trouble)
                notices.append(Notice("frames_dropped", "warning", text))
            elif trouble in _PLAIN:
                self._warned.add(trouble)
                notices.append(Notice("bus_warning", "warning", text))

    def _enter(self, state: BusState, text: str, notices: list[Notice]) -> None:
        if state.value <= self.state.value:
            return
        self.state = state
        self._quiet = 0
        notices.append(Notice(_KIND[state], "error", text, stops=True))

    def _leave(self) -> None:
        self.state = BusState.ACTIVE
        self.recovering = True
