from __future__ import annotations

from collections.abc import Iterator

import pytest

from deploy.bus_cycles import CycleGrouper, by_time
from deploy.bus_frames import BusFrame
from hal.profile.frames import pack, unpack
from schemas.base import Clock
from schemas.load import load_robot

SYNC = pack(0x080, b"")
HEARTBEAT = pack(0x77F, b"\x05")
COMMAND = pack(0x201, bytes(7))
REPORT = pack(0x181, bytes(8))


class TestCycles:
    """Two buses of arm9 and a third that is always there; times in ms."""

    def group(self, clock: Clock, *frames: tuple[float, str, bytes]) -> dict[int, dict[str, list[int]]]:
        """Identifiers sent and received by cycle and bus, of the first bus alone where others are the same."""
        description = load_robot("arm9").description
        grouper = CycleGrouper(description, clock)
        sent = (SYNC, HEARTBEAT, COMMAND)
        found = []
        for time_ms, bus, frame in frames:
            found += list(grouper.add(BusFrame(round(time_ms * 1e6), bus, frame, sent=frame in sent)))
        found += list(grouper.finish())
        assert [cycle.sequence for cycle in found] == sorted(cycle.sequence for cycle in found)
        return {
            cycle.sequence: {
                bus: [number for side in (cycle.sent, cycle.received) for number, _ in unpack(bytes(side[bus]))]
                for bus in ("arm9-0", "arm9-1")
            }
            for cycle in found
        }

    def test_a_heartbeat_belongs_to_the_sync_after_it(self) -> None:
        a = "arm9-0"
        cycles = self.group(
            Clock.LOCKSTEP, (0, a, SYNC), (0.1, a, REPORT), (1, a, COMMAND), (1.9, a, HEARTBEAT), (2, a, SYNC)
        )
        assert [cycle[a] for cycle in cycles.values()] == [[0x080, 0x201, 0x181], [0x77F, 0x080]]

    def test_what_comes_between_heartbeat_and_sync_is_the_old_cycles(self) -> None:
        a = "arm9-0"
        cycles = self.group(Clock.LOCKSTEP, (0, a, SYNC), (1.9, a, HEARTBEAT), (1.95, a, REPORT), (2, a, SYNC))
        assert [cycle[a] for cycle in cycles.values()] == [[0x080, 0x181], [0x77F, 0x080]]

    def test_a_heartbeat_before_another_command_or_the_end_stays(self) -> None:
        a = "arm9-0"
        cycles = self.group(Clock.LOCKSTEP, (0, a, SYNC), (1, a, HEARTBEAT), (1.1, a, COMMAND), (1.2, a, HEARTBEAT))
        assert cycles == {0: {a: [0x080, 0x77F, 0x201, 0x77F], "arm9-1": []}}

    @pytest.mark.parametrize(("clock", "sequences"), [(Clock.LOCKSTEP, [0, 1, 2]), (Clock.REALTIME, [0, 1, 4])])
    def test_left_out_syncs_show_in_realtime_alone(self, clock: Clock, sequences: list[int]) -> None:
        a = "arm9-0"
        assert list(self.group(clock, (0, a, SYNC), (2.3, a, SYNC), (8.1, a, SYNC))) == sequences

    def test_a_lost_sync_of_one_bus_leaves_the_others_in_step(self) -> None:
        a, b = "arm9-0", "arm9-1"
        cycles = self.group(
            Clock.LOCKSTEP,
            (0, a, SYNC), (0, b, SYNC), (1, a, COMMAND),
            (2, a, SYNC), (2.1, b, REPORT), (3, a, COMMAND),
            (4, a, SYNC), (4, b, SYNC), (4.1, b, REPORT),
        )  # fmt: skip
        assert cycles[0][b] == [0x080, 0x181]
        assert cycles[1][b] == []
        assert cycles[2][b] == [0x080, 0x181]

    def test_a_command_that_is_late_on_one_bus_does_not_begin_a_cycle(self) -> None:
        a, b = "arm9-0", "arm9-1"
        cycles = self.group(
            Clock.LOCKSTEP,
            (0, a, SYNC), (0, b, SYNC), (1.9, b, COMMAND),
            (2, b, SYNC), (2.05, a, COMMAND), (2.1, a, SYNC),
        )  # fmt: skip
        assert cycles == {0: {a: [0x080, 0x201], b: [0x080, 0x201]}, 1: {a: [0x080], b: [0x080]}}

    @pytest.mark.parametrize(("clock", "late_cycle"), [(Clock.REALTIME, 0), (Clock.LOCKSTEP, 1)])
    def test_a_sync_after_another_buss_command_is_late_in_realtime_alone(self, clock: Clock, late_cycle: int) -> None:
        a, b = "arm9-0", "arm9-1"
        cycles = self.group(clock, (0, a, SYNC), (0.6, a, COMMAND), (0.7, b, SYNC), (2, a, SYNC))
        assert cycles[late_cycle][b] == [0x080]

    def test_half_a_period_later_it_is_the_next_in_realtime_too(self) -> None:
        a, b = "arm9-0", "arm9-1"
        cycles = self.group(Clock.REALTIME, (0, a, SYNC), (0.6, a, COMMAND), (2, b, SYNC), (2.01, a, SYNC))
        assert (cycles[0][b], cycles[1][b]) == ([], [0x080])


class TestByTime:
    """A file that is ahead on one bus; times in ns."""

    def order(self, *frames: tuple[int, str], window_ns: int = 1000) -> list[tuple[int, str]]:
        each = [BusFrame(time_ns, bus, SYNC, sent=True) for time_ns, bus in frames]
        return [(frame.time_ns, frame.bus) for frame in by_time(each, window_ns)]

    def test_buses_are_put_in_step(self) -> None:
        assert self.order((1, "a"), (5, "a"), (9, "a"), (2, "b"), (6, "b")) == [
            (1, "a"), (2, "b"), (5, "a"), (6, "b"), (9, "a"),
        ]  # fmt: skip

    def test_a_bus_keeps_its_order_though_its_clock_steps_back(self) -> None:
        assert self.order((10, "a"), (3, "a"), (12, "a"), (11, "b")) == [(10, "a"), (3, "a"), (11, "b"), (12, "a")]

    def test_equal_times_keep_the_files_order(self) -> None:
        assert self.order((1, "b"), (1, "a"), (1, "c")) == [(1, "b"), (1, "a"), (1, "c")]

    def test_frames_leave_when_the_window_has_passed(self) -> None:
        def frames() -> Iterator[BusFrame]:
            for time_ns in range(0, 10_000, 100):
                yield BusFrame(time_ns, "a", SYNC, sent=True)
            raise AssertionError

        assert next(by_time(frames(), 1000)).time_ns == 0
