"""A log's cycles laid out in time: order, durations, nothing before its turn."""

from __future__ import annotations

from itertools import pairwise

import pytest

from deploy.bus_frames import BusFrame, cycles, duration_ns, from_zero, hal_identifiers, in_time
from hal.profile.frames import CAN_ERR_FLAG, pack
from schemas.load import load_robot
from schemas.messages import BusFrames
from tests.deploy.bus_logs import SCENARIOS, Recorded, recorded

ARM9 = load_robot("arm9").description
PERIOD = ARM9.period_ns


def laid_out(log: Recorded) -> list[BusFrame]:
    return list(in_time(log.run.robot.description, log.frames))


def cycle(sequence: int, bus: str = "arm9-0", *, sent: bytes = pack(0x080, b""), received: bytes = b"") -> BusFrames:
    return BusFrames(sequence=sequence, time_ns=max(sequence, 0) * PERIOD, bus=bus, sent=sent, received=received)


@pytest.mark.parametrize("robot", SCENARIOS)
def test_every_frame_of_the_log_is_there_once_in_its_order(robot: str) -> None:
    log = recorded(robot)
    frames = laid_out(log)
    for bus in log.run.robot.description.buses:
        for sent in (True, False):
            whole = b"".join((each.sent if sent else each.received) for each in log.frames if each.bus == bus.name)
            assert b"".join(each.frame for each in frames if each.bus == bus.name and each.sent is sent) == whole


@pytest.mark.parametrize("robot", SCENARIOS)
def test_frames_of_a_bus_never_overlap_and_all_are_in_the_order_of_time(robot: str) -> None:
    log = recorded(robot)
    frames = laid_out(log)
    assert all(one.time_ns <= other.time_ns for one, other in pairwise(frames))
    for bus in log.run.robot.description.buses:
        line = [each for each in frames if each.bus == bus.name]
        for one, other in pairwise(line):
            assert one.time_ns + duration_ns(one.frame, bus.bitrate) <= other.time_ns


@pytest.mark.parametrize("robot", SCENARIOS)
def test_sync_k_is_at_k_periods_on_every_bus_and_the_boot_before(robot: str) -> None:
    log = recorded(robot)
    description = log.run.robot.description
    frames = laid_out(log)
    for bus in description.buses:
        syncs = [each.time_ns for each in frames if each.bus == bus.name and each.can_id == 0x080]
        assert syncs == [k * description.period_ns for k in range(len(syncs))]
    assert frames[0].time_ns < 0
    assert frames[0].time_ns % description.period_ns == 0


def test_commands_wait_for_the_slowest_buss_reports_and_the_computing() -> None:
    log = recorded("arm9")
    cycle_frames = [each for each in laid_out(log) if 0 <= each.time_ns < PERIOD]
    reports_end = max(each.time_ns + duration_ns(each.frame, 1_000_000) for each in cycle_frames if not each.sent)
    first_commands = {
        bus: min(
            each.time_ns for each in cycle_frames if each.bus == bus and 0x200 <= each.can_id < 0x400 and each.sent
        )
        for bus in ("arm9-0", "arm9-1", "arm9-2")
    }
    assert set(first_commands.values()) == {reports_end + round(ARM9.compute_budget_s * 1e9)}


@pytest.mark.parametrize("robot", SCENARIOS)
def test_the_boot_has_each_sdo_answer_after_its_request(robot: str) -> None:
    log = recorded(robot)
    asked: dict[tuple[str, int], bytes | None] = {}
    answers = 0
    for each in laid_out(log):
        node = each.can_id & 0x7F
        if each.can_id - node == 0x600:
            assert asked.get((each.bus, node)) is None
            asked[each.bus, node] = each.data[1:4]
        elif each.can_id - node == 0x580:
            assert asked[each.bus, node] == each.data[1:4]
            asked[each.bus, node] = None
            answers += 1
    assert answers > 50


def test_heartbeats_of_the_hal_stand_just_before_their_sync() -> None:
    frames = list(in_time(ARM9, [cycle(3, sent=pack(0x77F, b"\x05") + pack(0x080, b""))], 1))
    assert [each.can_id for each in frames] == [0x77F, 0x080]
    assert frames[1].time_ns == 3 * PERIOD == frames[0].time_ns + duration_ns(frames[0].frame, 1_000_000)


def test_a_cycle_that_needs_more_than_a_period_delays_the_next() -> None:
    reports = b"".join(pack(0x181, bytes(8)) for _ in range(20))  # 20 × more than 111 µs
    frames = list(in_time(ARM9, [cycle(0, received=reports), cycle(1), cycle(2)], 1))
    syncs = [each.time_ns for each in frames if each.can_id == 0x080]
    assert syncs[0] == 0
    assert PERIOD < syncs[1] < 2 * PERIOD
    assert syncs[2] == 2 * PERIOD


def test_commands_that_would_miss_the_next_sync_go_earlier() -> None:
    robot = ARM9.model_copy(update={"compute_budget_s": ARM9.period_s})
    frames = list(in_time(robot, [cycle(0, sent=pack(0x080, b"") + pack(0x201, bytes(7)), received=b""), cycle(1)], 1))
    assert [each.can_id for each in frames] == [0x080, 0x201, 0x080]
    assert frames[1].time_ns + duration_ns(frames[1].frame, 1_000_000) <= PERIOD


def test_error_frames_take_no_time_on_the_wire() -> None:
    assert duration_ns(pack(CAN_ERR_FLAG | 0x40, bytes(8)), 1_000_000) == 0
    assert duration_ns(pack(0x080, b""), 500_000) == 2 * duration_ns(pack(0x080, b""), 1_000_000)


def test_cycles_come_in_order_though_buses_were_written_apart() -> None:
    messages = [cycle(0, "a"), cycle(1, "a"), cycle(0, "b"), cycle(2, "a"), cycle(1, "b")]
    assert [(sequence, set(each)) for sequence, each in cycles(messages, 2)] == [
        (0, {"a", "b"}), (1, {"a", "b"}), (2, {"a"}),
    ]  # fmt: skip


def test_files_begin_at_zero_or_later_by_whole_periods() -> None:
    frames = [BusFrame(time_ns, "a", bytes(16), sent=True) for time_ns in (-2_300_000, 0)]
    assert [each.time_ns for each in from_zero(frames, PERIOD)] == [1_700_000, 4_000_000]
    assert list(from_zero(frames[1:], PERIOD)) == frames[1:]


def test_the_hal_sends_nmt_sync_heartbeat_commands_requests_and_starts_sensors() -> None:
    ids = hal_identifiers(ARM9, "arm9-2")
    assert {0x000, 0x080, 0x77F, 0x207, 0x307, 0x607, 0x1C8} <= ids
    assert ids.isdisjoint({0x087, 0x187, 0x287, 0x587, 0x707, 0x1C0, 0x1C1, 0x201})
