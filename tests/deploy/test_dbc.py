"""The DBC text as other tools read it: cantools decodes a run's frames as the HAL does."""

from __future__ import annotations

from functools import lru_cache

import pytest
from canopen.objectdictionary import INTEGER8, INTEGER16, INTEGER32
from cantools.database import Database, load_string

from deploy.bus_layout import dictionary
from deploy.dbc import dbc_text, identifier
from hal.bus.can_frame import split
from hal.profile import objects
from hal.profile.units import DriveUnits
from schemas.base import ControlMode
from schemas.load import load_robot
from schemas.messages import RobotState
from tests.deploy.bus_logs import SCENARIOS, recorded

ROUNDING = 1e-9
"""Of one count: a decimal factor of 16 digits is as good as the number."""


@lru_cache
def database(robot: str, bus: str) -> Database:
    found = load_string(dbc_text(recorded(robot).run.robot.description, bus), "dbc")
    assert isinstance(found, Database)
    return found


def decoded(robot: str, bus: str, packet: bytes) -> dict[str, dict[str, object]]:
    """Signals by message name, of every frame of a packet; a frame that the DBC lacks is an error."""
    found = {}
    for frame in split(packet):
        message = database(robot, bus).get_message_by_frame_id(int.from_bytes(frame[:4], "little"))
        assert message.length == frame[4], message.name
        found[message.name] = message.decode(frame[8 : 8 + frame[4]])
    return found


@pytest.mark.parametrize("robot", SCENARIOS)
def test_reports_decode_to_the_hals_states(robot: str) -> None:
    log = recorded(robot)
    description = log.run.robot.description
    units = DriveUnits.of(description)
    compared = 0
    for frames in log.frames:
        state = log.states.get(frames.sequence)
        found = decoded(robot, frames.bus, frames.received)
        if state is None or frames.sequence < 0:
            continue
        for index, joint in enumerate(description.joints):
            if joint.drive.bus != frames.bus:
                continue
            signals = found[f"{joint.name}_TPDO1"]
            one_count = abs(units.radian_per_count[index]) * ROUNDING
            assert signals["position"] == pytest.approx(state.position_measured[index], abs=one_count)
            assert str(signals["state"]) == state.drive_state[index].name.lower().replace("_", " ")
            if state.motor_torque_measured is None:
                assert "torque" not in signals
            else:
                one_per_mille = abs(units.newton_metre_per_mille[index]) * ROUNDING
                assert signals["torque"] == pytest.approx(state.motor_torque_measured[index], abs=one_per_mille)
            mode = found.get(f"{joint.name}_TPDO2", {}).get("mode")
            assert mode is None or (str(mode) == "CST") == (state.mode[index] is ControlMode.TORQUE)
            compared += 1
        _compare_sensors(found, state, frames.bus, robot)
    assert compared == len(log.states) * len(description.joints)


def _compare_sensors(found: dict[str, dict[str, object]], state: RobotState, bus: str, robot: str) -> None:
    description = recorded(robot).run.robot.description
    wrenches = {sample.name: sample for sample in state.wrenches}
    for sensor in description.force_torque_sensors:
        if sensor.bus != bus or wrenches[sensor.name].age_cycles:
            continue
        first, second = found[f"{sensor.name}_FT_1"], found[f"{sensor.name}_FT_2"]
        force = tuple(float(str(first[f"force_{axis}"])) for axis in "xyz")
        torque_x = float(str(first["torque_x_high"])) + float(str(second["torque_x_low"]))
        torque = (torque_x, *(float(str(second[f"torque_{axis}"])) for axis in "yz"))
        assert force == pytest.approx(wrenches[sensor.name].force_in_sensor, abs=1e-9)
        assert torque == pytest.approx(wrenches[sensor.name].torque_in_sensor, abs=1e-9)
    imus = {sample.name: sample for sample in state.imus}
    for imu in description.imus:
        if imu.bus != bus or imus[imu.name].age_cycles:
            continue
        gyro, acceleration = found[f"{imu.name}_gyro"], found[f"{imu.name}_acceleration"]
        rates = tuple(gyro[f"angular_velocity_{axis}"] for axis in "xyz")
        assert rates == pytest.approx(imus[imu.name].angular_velocity_in_imu, abs=1e-9)
        forces = tuple(acceleration[f"acceleration_{axis}"] for axis in "xyz")
        assert forces == pytest.approx(imus[imu.name].acceleration_in_imu, abs=1e-9)
        quaternion = found[f"{imu.name}_orientation"]
        turned = tuple(quaternion[f"orientation_{axis}"] for axis in "wxyz")
        assert turned == pytest.approx(imus[imu.name].orientation_imu_to_world, abs=1e-4)  # not normalised there


@pytest.mark.parametrize("robot", SCENARIOS)
def test_commands_decode_to_what_the_hal_applied(robot: str) -> None:
    log = recorded(robot)
    description = log.run.robot.description
    units = DriveUnits.of(description)
    compared = 0
    for frames in log.frames:
        applied = log.states[frames.sequence + 1].applied if frames.sequence + 1 in log.states else None
        found = decoded(robot, frames.bus, frames.sent)
        if applied is None or applied.position is None or frames.sequence < 0:
            continue
        for index, joint in enumerate(description.joints):
            if joint.drive.bus == frames.bus:
                half = 0.5 * abs(units.radian_per_count[index]) * (1.0 + 1e-6)
                target = found[f"{joint.name}_RPDO1"]["target_position"]
                assert target == pytest.approx(applied.position[index], abs=half)
                compared += 1
    assert compared


def test_torque_commands_have_the_joints_sign() -> None:
    log = recorded("crane")
    signs = set()
    for frames in log.frames:
        state = log.states.get(frames.sequence + 1)
        if state is None or state.applied.torque is None or frames.sequence < 0:
            continue
        found = decoded("crane", frames.bus, frames.sent)
        for index, joint in enumerate(log.run.robot.description.joints):
            if joint.drive.bus == frames.bus and abs(state.applied.torque[index]) > 1.0:
                effort = float(str(found[f"{joint.name}_RPDO2"]["target_torque"]))
                limit = joint.drive.dead_zone + 0.5 * joint.gear_ratio * joint.drive.rated_motor_torque / 1000.0
                assert abs(effort - state.applied.torque[index]) <= limit * (1.0 + 1e-9)
                signs.add(effort > 0.0)
    assert signs == {True, False}


@pytest.mark.parametrize(
    ("name", "record"), [("TPDO1", 0x1A00), ("TPDO2", 0x1A01), ("RPDO1", 0x1600), ("RPDO2", 0x1601)]
)
def test_pdos_of_the_kind_torque_are_the_eds_files_defaults(name: str, record: int) -> None:
    """Each mapped object is covered by signals, whole and in its place, with the sign of its type."""
    message = database("arm9", "arm9-0").get_message_by_name(f"scapula_yaw_{name}")
    mapping = dictionary()[record]
    bits = {signal.start + bit: signal for signal in message.signals for bit in range(signal.length)}
    start = 0
    for number in range(1, mapping[0].default + 1):
        entry = mapping[number].default
        index, length = entry >> 16, entry & 0xFF
        signals = {bits[bit].name: bits[bit] for bit in range(start, start + length)}
        assert sum(signal.length for signal in signals.values()) == length
        signed = dictionary().get_variable(index, 0).data_type in (INTEGER8, INTEGER16, INTEGER32)
        assert {signal.is_signed for signal in signals.values()} == {signed}
        assert (index == objects.STATUSWORD) == (len(signals) > 1)
        start += length
    assert message.length * 8 == start == len(bits)


@pytest.mark.parametrize("robot", SCENARIOS)
def test_every_pdo_of_each_drive_is_there_and_no_other(robot: str) -> None:
    description = recorded(robot).run.robot.description
    for joint in description.joints:
        names = {message.name for message in database(robot, joint.drive.bus).messages}
        pdos = {name.rsplit("_", 1)[1] for name in names if name.startswith(f"{joint.name}_") and "PDO" in name}
        wanted = {f"RPDO{pdo.number + 1}" for pdo in objects.RPDOS[joint.drive.kind]} | {"TPDO1", "TPDO2"}
        assert pdos == wanted


def test_senders_and_cycle_times() -> None:
    dbc = database("arm9", "arm9-2")
    report, command = (dbc.get_message_by_name(f"wrist_roll_{name}") for name in ("TPDO1", "RPDO1"))
    assert (report.senders, command.senders) == (["wrist_roll"], ["hal"])
    assert report.cycle_time == 2
    assert {node.name for node in dbc.nodes} == {"hal", "wrist_yaw", "wrist_pitch", "wrist_roll", "wrist"}


def test_the_text_is_ascii_and_says_what_is_split() -> None:
    text = dbc_text(load_robot("arm9").description, "arm9-2")
    assert text.isascii()
    assert 'CM_ BO_ 448 "torque x = torque_x_high' in text


@pytest.mark.parametrize(
    ("name", "expected"), [("elbow", "elbow"), ("l-arm/1", "l_arm_1"), ("2nd", "_2nd"), ("ä", "_")]
)
def test_names_become_identifiers(name: str, expected: str) -> None:
    assert identifier(name) == expected


def test_joints_whose_names_differ_by_illegal_characters_stay_apart() -> None:
    robot = load_robot("arm9").description
    first, second = robot.joints[0], robot.joints[1]
    renamed = tuple(joint.model_copy(update={"name": name}) for joint, name in ((first, "arm-1"), (second, "arm.1")))
    changed = robot.model_copy(update={"joints": (*renamed, *robot.joints[2:])})
    dbc = load_string(dbc_text(changed, "arm9-0"), "dbc")
    assert isinstance(dbc, Database)
    assert {"arm_1_TPDO1", "arm_1_2_TPDO1"} <= {message.name for message in dbc.messages}
