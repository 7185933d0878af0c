from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from hal.cycle import HalCore
from hal.errors import DriveFaultError, HalError
from hal.profile.firmware import FirmwareGains, dead_zone, position_torque
from hal.profile.frames import unpack
from hal.profile.units import DriveUnits
from schemas.base import ControlMode
from schemas.messages import DriveState, Event, HalStatus, JointCommand, RobotState
from schemas.robot import RobotDescription
from tests.hal.robots import ENABLED, FAULT, by_bus, frame, mode_report, report, robot, wrist


class Loop:
    """A core with drives that latch at the next SYNC and report the positions and torques given here."""

    def __init__(self, *kinds: str, positions: list[float] | None = None, **fields: Any) -> None:
        self.robot: RobotDescription = robot(*(kinds or ("torque", "torque")), **fields)
        self.units, self.gains = DriveUnits.of(self.robot), FirmwareGains.of(self.robot)
        count = len(self.robot.joints)
        # On whole encoder counts, so that the tests' equalities are exact.
        start = np.array(positions or [0.0] * count)
        self.position = self.units.position_from_counts(self.units.counts_from_position(start))
        self.velocity = np.zeros(count)
        self.torque = np.zeros(count)
        self.statusword = [ENABLED] * count
        self.silent: set[int] = set()
        self.extra: list[bytes] = [b"", b""]
        self.core = HalCore(self.robot)
        self.core.start(self.position)
        self.sequence = -1
        self.sent: list[dict[int, bytes]] = []
        self.modes = [8] * count

    def sync(self) -> RobotState:
        """Latch what was sent last, report."""
        self.sequence += 1
        reports = []
        counts = self.units.counts_from_position(self.position)
        per_mille = self.units.per_mille_from_torque(self.torque)
        for index, joint in enumerate(self.robot.joints):
            node = joint.drive.node_id
            part = (
                b"" if index in self.silent else report(node, counts[index], per_mille[index], self.statusword[index])
            )
            mode = self.modes[index]
            if self.sent and 0x300 + node in self.sent[-1]:
                mode = 10
            elif self.sent and 0x200 + node in self.sent[-1]:
                mode = 8
            if mode != self.modes[index] and part:
                self.modes[index] = mode
                part += mode_report(node, mode)
            reports.append(part)
        buses = [part + extra for part, extra in zip(by_bus(self.robot, reports), self.extra, strict=True)]
        self.extra = [b"", b""]
        return self.core.decode(self.sequence, buses)

    def answer(self, command: JointCommand | None) -> dict[int, bytes]:
        self.sent.append(dict(unpack(b"".join(self.core.apply(command)))))
        return self.sent[-1]

    def cycle(self, mode: ControlMode | None = None, **fields: Any) -> RobotState:
        """One SYNC and its answer; no mode: no command."""
        self.position = self.position + self.velocity * self.robot.period_s
        state = self.sync()
        self.answer(None if mode is None else self.command(mode, **fields))
        return state

    def command(self, mode: ControlMode, **fields: Any) -> JointCommand:
        options: dict[str, Any] = {"session": "me", "sequence": self.sequence, "time_ns": 0} | fields
        return JointCommand(mode=mode, **options)

    def target(self) -> np.ndarray:
        """Target positions [rad] sent last."""
        frames = [self.sent[-1][0x200 + joint.drive.node_id] for joint in self.robot.joints]
        return self.units.position_from_counts(np.array([struct.unpack_from("<i", data, 3)[0] for data in frames]))

    def asked(self) -> np.ndarray:
        """Target torques [N·m] sent last."""
        frames = [self.sent[-1][0x300 + joint.drive.node_id] for joint in self.robot.joints]
        return self.units.torque_from_per_mille(np.array([struct.unpack_from("<h", data, 3)[0] for data in frames]))

    def firmware(self, target: np.ndarray) -> np.ndarray:
        """Motor torque of the position law at the latch to come."""
        ahead = self.position + self.velocity * self.robot.period_s
        return position_torque(target, np.zeros(len(target)), ahead, self.velocity, self.gains)

    def events(self, kind: str) -> list[Event]:
        return [event for event in self.core.drain_events() if event.kind == kind]


P, T, S = ControlMode.POSITION, ControlMode.TORQUE, ControlMode.SERVO


def close(values: Any, expected: Any) -> Any:
    return np.asarray(values) == pytest.approx(np.asarray(expected), abs=1e-5)


def test_before_the_first_command_the_start_is_held() -> None:
    loop = Loop(positions=[0.3, -0.2])
    state = loop.cycle()
    assert state.sequence == 0
    assert state.applied.sequence == -1
    assert state.applied.mode is P
    assert close(state.applied.position, [0.3, -0.2])
    assert close(loop.target(), [0.3, -0.2])
    for _ in range(10):
        loop.cycle()
    assert loop.core.status is HalStatus.ACTIVE
    assert loop.core.missed_commands == 0


def test_states_are_valid_messages() -> None:
    loop = Loop("torque", "position_pd", force_torque_sensors=(wrist(),))
    loop.extra[1] = frame(0x50, bytes.fromhex("0b0032ffce01f403")) + frame(0x51, bytes(8))
    state = loop.cycle()
    assert RobotState.model_validate_json(state.model_dump_json()) == state
    assert state.time_ns == 0
    assert loop.cycle().time_ns == 2_000_000
    assert state.motor_torque_measured is None
    assert Loop("torque").cycle().motor_torque_measured == (0.0,)
    assert state.drive_state == (DriveState.OPERATION_ENABLED,) * 2


@pytest.mark.parametrize("delay", [1, 2])
def test_a_command_is_latched_after_the_delay(delay: int) -> None:
    loop = Loop("torque", command_delay_cycles=delay)
    applied = [loop.cycle(P, position=(0.001 * step,)).applied for step in range(5)]
    expected = [-1] * delay + list(range(5 - delay))
    assert [command.sequence for command in applied] == expected
    assert [command.position[0] for command in applied if command.position] == pytest.approx(
        [0.001 * max(0, sequence) for sequence in expected]
    )


def test_torque_commands_ask_for_the_inverse_dead_zone() -> None:
    loop = Loop()
    loop.cycle(T, torque=(30.0, -30.0))
    delivered = dead_zone(loop.asked(), loop.gains.dead_zone)
    assert delivered == pytest.approx([30.0, -30.0], abs=0.026)
    state = loop.cycle(T, torque=(30.0, -30.0))
    assert state.mode == (T, T)
    assert state.applied.torque == (30.0, -30.0)
    assert [event.text for event in loop.events("mode_change")] == ["mode position → torque"]


def test_servo_commands_carry_a_limited_torque_limit() -> None:
    loop = Loop("servo")
    loop.cycle(S, position=(0.0,), torque_limit=(10.0,))
    assert loop.sent[-1][0x201][6:] == (200).to_bytes(2, "little")
    state = loop.cycle(S, position=(0.0,), torque_limit=(1e4,))
    assert state.mode == (S,)
    assert loop.sent[-1][0x201][6:] == (2000).to_bytes(2, "little")
    (event,) = loop.events("limited")
    assert (event.joint, "torque limit" in event.text) == ("j0", True)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"session": "other"}, "session"),
    ({"sequence": 0}, "sequence"),
    ({"position": None}, "position is None"),
    ({"position": (0.0,)}, "length of position"),
    ({"position": None, "torque": (0.0, 0.0), "mode": S}, "mode is 'servo'"),
    ({"position": (0.0, float("nan"))}, "joint j1: position is nan"),
]


@pytest.mark.parametrize(("changes", "reason"), REFUSED)
def test_bad_commands_are_refused_and_the_last_good_one_held(changes: dict[str, Any], reason: str) -> None:
    loop = Loop()
    loop.cycle(P, position=(0.005, 0.005))
    loop.sync()
    bad = loop.command(P, position=(0.006, 0.006)).model_copy(update=changes)
    assert not loop.core.accepts(bad)
    loop.answer(bad)
    assert close(loop.target(), [0.005, 0.005])
    (event,) = loop.events("command_refused")
    assert reason in event.text
    assert loop.core.missed_commands == 1
    assert loop.cycle(P, position=(0.007, 0.007)).applied.sequence == 0
    assert loop.core.status is HalStatus.ACTIVE
    assert close(loop.target(), [0.007, 0.007])


def test_the_session_of_the_first_good_command_is_kept() -> None:
    loop = Loop()
    loop.cycle(P, session="other", sequence=99, position=(0.0, 0.0))
    assert loop.core.session is None
    loop.cycle(P, position=(0.0, 0.0))
    assert loop.core.session == "me"


def test_missed_commands_in_a_row_stop_the_robot() -> None:
    loop = Loop(positions=[0.2, 0.2])
    loop.cycle(P, position=(0.205, 0.195))
    loop.cycle()
    loop.cycle()
    loop.cycle(P, position=(0.206, 0.194))
    for _ in range(2):
        loop.cycle()
    assert loop.core.status is HalStatus.ACTIVE
    loop.cycle()
    assert loop.core.status is HalStatus.SAFE_STOP
    assert len(loop.events("safe_stop")) == 1
    state = loop.cycle(P, position=(0.5, 0.5))
    assert state.status is HalStatus.SAFE_STOP
    assert close(loop.target(), [0.206, 0.194])
    assert loop.core.missed_commands == 5
    loop.core.reset()
    assert loop.core.status is HalStatus.SAFE_STOP


def held_torque(loop: Loop, velocity: float = 0.0) -> None:
    loop.velocity = np.array([velocity, -velocity])
    for torque in (20.0, 35.0, 35.0):
        loop.cycle(T, torque=(torque, -torque))
    for _ in range(10):
        loop.cycle(T, torque=(35.0, -35.0))


@pytest.mark.parametrize("velocity", [0.0, 0.3])
def test_a_safe_stop_from_torque_holds_the_torque_and_then_the_position(velocity: float) -> None:
    loop = Loop(positions=[0.3, -0.4])
    held_torque(loop, velocity)
    loop.position = loop.position + loop.velocity * loop.robot.period_s
    loop.sync()
    before = dead_zone(loop.asked(), loop.gains.dead_zone)
    loop.core.stop("test")
    loop.answer(loop.command(T, torque=(0.0, 0.0)))
    encoder = 4000.0 * 2 * np.pi / 409600 * 4 + 40.0 * 2 * np.pi / 409600 * 500
    assert np.abs(loop.firmware(loop.target()) - before).max() < encoder
    where = loop.position + loop.velocity * loop.robot.period_s
    loop.velocity = np.zeros(2)
    targets = []
    for _ in range(12):
        loop.cycle()
        targets.append(loop.target())
    steps = np.abs(np.diff(targets, axis=0)[:9])
    assert (steps[1] < steps[4]).all(), "it starts gently"
    assert (steps[8] < steps[4]).all(), "and ends gently"
    assert np.abs(targets[-1] - where).max() < 5e-5
    assert loop.core.status is HalStatus.SAFE_STOP


@pytest.mark.parametrize("delay", [1, 2])
def test_a_planned_change_to_position_starts_at_the_rule_and_follows_the_commands(delay: int) -> None:
    loop = Loop(positions=[0.3, -0.4], command_delay_cycles=delay)
    held_torque(loop)
    before = dead_zone(loop.asked(), loop.gains.dead_zone)
    for _ in range(delay):
        loop.cycle(P, position=(0.305, -0.405))
    assert np.abs(loop.firmware(loop.target()) - before).max() < 4000 * 1.6e-5
    for _ in range(10 + delay):
        loop.cycle(P, position=(0.305, -0.405))
    assert close(loop.target(), [0.305, -0.405])
    assert loop.core.drain_events()[-1].text == "mode torque → position"


def test_a_stop_overtakes_the_delay() -> None:
    loop = Loop("torque", command_delay_cycles=2)
    for step in range(1, 4):
        loop.cycle(P, position=(0.005 * step,))
    loop.sync()
    loop.core.stop("now")
    loop.answer(None)
    # Latched at this SYNC was the first command; the later ones are dropped.
    assert close(loop.target(), [0.010])
    loop.cycle()
    assert close(loop.target(), [0.010])


@pytest.mark.parametrize("delay", [1, 2])
def test_an_emergency_stop_is_latched_until_reset(delay: int) -> None:
    loop = Loop("torque", command_delay_cycles=delay)
    loop.cycle(P, position=(0.0,))
    loop.core.stop("operator", emergency=True)
    loop.core.stop("operator", emergency=True)
    for _ in range(10):
        assert loop.cycle(P, position=(0.5,)).status is HalStatus.EMERGENCY_STOP
        assert close(loop.target(), [0.0])
    assert len(loop.events("emergency_stop")) == 1
    loop.core.reset()
    for _ in range(delay):
        loop.cycle(P, position=(0.5,))
    # One step of 5 rad/s at 500 Hz from the held target.
    assert close(loop.target(), [0.01])
    assert loop.cycle(P, position=(0.5,)).status is HalStatus.ACTIVE


def test_a_reset_clears_nothing_else() -> None:
    loop = Loop("torque")
    loop.cycle()
    loop.core.reset()
    assert [event.severity for event in loop.events("reset")] == ["warning"]
    loop.core.stop("fault")
    loop.core.stop("operator", emergency=True)
    loop.core.reset()
    assert loop.core.status is HalStatus.SAFE_STOP


def test_limits_hold_whatever_is_commanded_and_are_told_once() -> None:
    loop = Loop(positions=[1.99, 0.0])
    for _ in range(5):
        loop.cycle(P, position=(5.0, 0.0))
    assert close(loop.target(), [2.0, 0.0])
    assert [event.joint for event in loop.events("limited")] == ["j0"]
    loop.torque = np.array([10.0, 0.0])
    loop.cycle(T, torque=(500.0, 0.0))
    # 40 N·m a cycle from the 10 N·m that the motor gave in position mode.
    assert loop.asked()[0] == pytest.approx(52.0, abs=0.05)
    for _ in range(5):
        loop.cycle(T, torque=(500.0, 0.0))
    assert loop.sync().applied.torque == (100.0, 0.0)


def test_a_faulted_drive_stops_the_robot_and_is_not_reset() -> None:
    loop = Loop()
    loop.cycle(T, torque=(10.0, 10.0))
    loop.statusword[1] = FAULT
    loop.position = np.array([0.0, 0.05])
    loop.extra[1] = mode_report(2, 10, 0x7305)
    state = loop.sync()
    assert state.drive_state[1] is DriveState.FAULT
    assert state.error_code == (0, 0x7305)
    assert state.status is HalStatus.SAFE_STOP
    loop.answer(loop.command(T, torque=(10.0, 10.0)))
    assert loop.sent[-1][0x201][:2] == b"\x0f\x00"
    assert loop.sent[-1][0x202][:2] == b"\x00\x00"
    assert close(loop.target()[1], 0.05)
    (event,) = loop.events("drive_fault")
    assert event.joint == "j1"
    assert "0x7305" in event.text
    assert isinstance(loop.core.cause, DriveFaultError)
    assert (loop.core.cause.joint, loop.core.cause.error_code) == ("j1", 0x7305)


def test_a_disabled_drive_is_enabled_where_it_stands() -> None:
    loop = Loop("torque", positions=[0.3])
    loop.cycle(P, position=(0.3,))
    words = []
    for statusword in (0x0640, 0x0621, 0x0623, 0x0627):
        loop.statusword[0] = statusword
        loop.position = loop.position - 0.01
        loop.cycle()
        words.append(loop.sent[-1][0x201][0])
    assert words == [0x06, 0x07, 0x0F, 0x0F]
    assert close(loop.target(), [0.27])


def test_a_drive_that_was_lost_is_not_enabled_again() -> None:
    loop = Loop("torque", positions=[0.3])
    loop.cycle(P, position=(0.3,))
    loop.silent = {0}
    for _ in range(loop.robot.safety.sync_timeout_cycles):
        loop.cycle()
    loop.silent = set()
    words = []
    for statusword in (ENABLED, 0x0640, 0x0621, 0x0623, ENABLED):
        loop.statusword[0] = statusword
        loop.cycle()
        words.append(loop.sent[-1][0x201][0])
    assert words == [0x0F, 0x00, 0x06, 0x07, 0x0F], "it is left as it is; one that holds goes on holding"


def test_a_drive_that_reports_an_error_is_not_enabled_again() -> None:
    loop = Loop("torque", positions=[0.3])
    loop.cycle(P, position=(0.3,))
    loop.statusword[0] = 0x0640
    loop.extra[0] = frame(0x081, bytes.fromhex("3081100000000000"))
    assert [loop.cycle() and loop.sent[-1][0x201][0] for _ in range(3)] == [0x00] * 3


def test_a_silent_drive_is_told_at_once_and_stops_after_the_timeout() -> None:
    loop = Loop()
    loop.cycle(P, position=(0.0, 0.0))
    loop.silent = {1}
    for _ in range(4):
        loop.cycle(P, position=(0.0, 0.0))
    assert loop.core.status is HalStatus.ACTIVE
    assert [event.joint for event in loop.events("report_missing")] == ["j1"]
    assert loop.cycle(P, position=(0.0, 0.0)).status is HalStatus.SAFE_STOP
    assert loop.core.expected_reports == (frozenset({0x181}), frozenset())
    assert isinstance(loop.core.cause, HalError)


def test_a_drive_that_keeps_its_mode_stops_the_robot() -> None:
    loop = Loop("torque")
    loop.cycle(T, torque=(5.0,))
    for _ in range(5):
        loop.sequence += 1
        loop.core.decode(loop.sequence, [report(1), b""])
        loop.answer(loop.command(T, torque=(5.0,)))
    assert loop.core.status is HalStatus.SAFE_STOP
    assert "reports mode 8, commanded is 10" in loop.events("mode_refused")[0].text


def test_expected_reports_include_mode_changes_and_sensors() -> None:
    loop = Loop(force_torque_sensors=(wrist(),))
    loop.cycle(T, torque=(1.0, 1.0))
    assert loop.core.expected_reports == (frozenset({0x181, 0x281}), frozenset({0x182, 0x282, 0x50, 0x51}))
    loop.cycle(T, torque=(1.0, 1.0))
    assert loop.core.expected_reports == (frozenset({0x181}), frozenset({0x182, 0x50, 0x51}))
    for _ in range(4):
        loop.cycle(T, torque=(1.0, 1.0))
    assert loop.core.expected_reports == (frozenset({0x181}), frozenset({0x182}))
    assert len(loop.events("sensor_silent")) == 1


def test_a_sensor_that_comes_back_is_told_and_awaited_again() -> None:
    loop = Loop("torque", force_torque_sensors=(wrist(),))
    for _ in range(6):
        loop.cycle()
    assert loop.core.expected_reports[1] == frozenset()
    loop.extra[1] = frame(0x50, bytes.fromhex("0b0032ffce01f403")) + frame(0x51, bytes(8))
    assert loop.cycle().wrenches[0].age_cycles == 0
    assert [event.severity for event in loop.events("sensor_back")] == ["info"]
    assert loop.core.expected_reports[1] == frozenset({0x50, 0x51})


def test_a_stopped_servo_keeps_its_last_target_and_limit() -> None:
    loop = Loop("servo")
    loop.cycle(S, position=(0.004,), torque_limit=(7.0,))
    loop.sync()
    last = loop.sent[-1][0x201]
    loop.core.stop("test")
    assert loop.answer(None)[0x201] == last
    applied = loop.sync().applied
    assert (applied.sequence, applied.mode, applied.torque_limit) == (-1, S, (7.0,))


def test_emergencies_and_resets_of_a_node_stop_the_robot() -> None:
    for foreign in (frame(0x082, struct.pack("<HB5s", 0x8250, 0x11, b"")), frame(0x702, b"\0")):
        loop = Loop()
        loop.cycle(P, position=(0.0, 0.0))
        loop.extra[1] = foreign
        assert loop.cycle(P, position=(0.0, 0.0)).status is HalStatus.SAFE_STOP
        assert isinstance(loop.core.cause, DriveFaultError)
        assert loop.core.cause.joint == "j1"


def test_misuse_is_refused() -> None:
    core = HalCore(robot("torque"))
    with pytest.raises(HalError, match="give one a joint"):
        core.start(np.zeros(2))
    core.start(np.zeros(1))
    with pytest.raises(HalError, match="before the first decode"):
        core.apply(None)
