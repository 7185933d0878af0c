"""Frames take their time on the simulated buses: what is late takes effect late, what does not fit starves."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from hal.profile.bits import frame_bits
from hal.profile.frames import pack, unpack
from plant_service.plant import Plant
from schemas.load import Run, load_run

SYNC = pack(0x080, b"")
PERIOD_NS = 2_000_000


def arm9(**changes: object) -> Run:
    run = load_run("arm9-transition")
    return replace(run, robot=replace(run.robot, description=run.robot.description.model_copy(update=changes)))


def on_one_bus() -> Run:
    robot = load_run("arm9-transition").robot.description
    only = robot.buses[0].name
    joints = tuple(j.model_copy(update={"drive": j.drive.model_copy(update={"bus": only})}) for j in robot.joints)
    sensors = tuple(sensor.model_copy(update={"bus": only}) for sensor in robot.force_torque_sensors)
    return arm9(buses=robot.buses[:1], joints=joints, force_torque_sensors=sensors)


class Arm:
    """All drives of a run enabled in torque mode's start, position mode 8; a cycle is `sync` → `command`."""

    def __init__(self, run: Run, *, free: bool = False) -> None:
        self.plant = Plant(run, free=free)
        robot = run.robot.description
        self.nodes = [[j.drive.node_id for j in robot.joints if j.drive.bus == bus.name] for bus in robot.buses]
        for bus, nodes in enumerate(self.nodes):
            for node in nodes:
                for index, sub, value, size in (
                    (0x1401, 1, 0x300 + node, 4),
                    (0x1006, 0, PERIOD_NS // 1000, 4),
                    (0x6060, 0, 8, 1),
                    (0x6040, 0, 0x06, 2),
                    (0x6040, 0, 0x07, 2),
                    (0x6040, 0, 0x0F, 2),
                ):
                    request = struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, sub, value)
                    self._send(bus, pack(0x600 + node, request), free)
            self._send(bus, pack(0x000, b"\x01\x00"), free)

    def _send(self, bus: int, frame: bytes, free: bool) -> None:
        """Boot: no time passes in lockstep, with `free` as much as a request and its answer take."""
        self.plant.deliver(bus, frame)
        if free:
            self.plant.pump(PERIOD_NS)
            self.plant.advance()

    def sync(self) -> list[dict[int, bytes]]:
        """SYNC on every bus, one period; the identifiers and data of each bus's answer."""
        answers = [dict(unpack(self.plant.deliver(bus, SYNC))) for bus in range(len(self.nodes))]
        self.plant.advance()
        return answers

    def command(self, per_mille: int = 0) -> None:
        """Ask all drives for torque mode by RPDO2."""
        for bus, nodes in enumerate(self.nodes):
            data = struct.pack("<Hbh", 0x0F, 10, per_mille)
            self.plant.deliver(bus, b"".join(pack(0x300 + node, data) for node in nodes))

    def modes(self) -> set[int]:
        return set(self.plant.truth().mode)

    def frames(self) -> dict[int, tuple[int, int, int]]:
        """Transmitted, late, replaced of each identifier since the last call, on all buses."""
        messages = self.plant.statistics(final=True)
        return {f.can_id: (f.frames, f.late, f.replaced) for message in messages for f in message.frames}


def cycles_until_torque(arm: Arm) -> int:
    """SYNCs after the one answered until all drives are in mode 10."""
    arm.sync()
    for count in range(1, 6):
        arm.command()
        arm.sync()
        if arm.modes() == {10}:
            return count
    raise AssertionError("never")


@pytest.mark.parametrize(
    ("budget_s", "delay", "cycles"),
    [
        (0.0006, 1, 1),
        (0.0015, 1, 2),  # the first reports take 0.65 ms, so no command is through after 2 ms
        (0.0020, 1, 2),
        (0.0026, 2, 1),  # with a delay of 2 the HAL sends a cycle later: a period of the computing is hidden
        (0.0036, 2, 2),
    ],
)
def test_a_command_that_is_not_through_before_its_sync_takes_effect_at_the_next(
    budget_s: float, delay: int, cycles: int
) -> None:
    arm = Arm(arm9(compute_budget_s=budget_s, command_delay_cycles=delay))
    assert cycles_until_torque(arm) == cycles
    late = sum(late for can_id, (_, late, _) in arm.frames().items() if can_id >> 7 == 0x300 >> 7)
    assert (late > 0) == (cycles > 1)


def test_reports_end_when_their_bits_are_through() -> None:
    arm = Arm(arm9())
    arm.sync()
    answers = arm.sync()[0]
    frames = [SYNC, *(pack(can_id, data) for can_id, data in answers.items())]
    first = arm.plant.statistics(final=True)[0]
    # The first SYNC is answered by TPDO2s as well, so its reports end last.
    assert first.report_end_max_s > 1e-6 * sum(map(frame_bits, frames))
    arm.sync()
    second = arm.plant.statistics(final=True)[0]
    assert second.report_end_max_s == pytest.approx(1e-6 * sum(map(frame_bits, frames)), abs=20e-6)
    assert second.load_mean == pytest.approx(sum(map(frame_bits, frames)) / 2000, abs=0.01)


def test_an_overloaded_bus_starves_the_highest_identifiers_and_never_queues() -> None:
    run = on_one_bus()
    arm = Arm(run)
    arm.plant.deliver(0, pack(run.robot.description.force_torque_sensors[0].command_id, b"\x0b" + bytes(7)))
    arm.sync()
    arm.frames()
    for _ in range(100):
        arm.command()
        arm.sync()
    frames = arm.frames()
    commands = {node: frames[0x300 + node] for node in arm.nodes[0]}
    sent = [commands[node][0] for node in sorted(commands)]
    assert sent == sorted(sent, reverse=True)
    assert sent[0] >= 99
    assert sent[-1] == 0
    for transmitted, late, replaced in commands.values():
        assert late == transmitted  # reports leave no room before the SYNC
        assert 99 <= transmitted + replaced <= 100
    reports = [frames[0x180 + node] for node in sorted(commands)]
    assert all(late == 0 for _, late, _ in reports)
    assert all(transmitted + replaced == 100 for transmitted, _, replaced in reports)


def test_no_frame_is_lost_or_late_on_buses_that_fit() -> None:
    arm = Arm(arm9())
    for _ in range(20):
        arm.sync()
        arm.command()
    arm.sync()
    frames = arm.frames()
    assert {(late, replaced) for _, late, replaced in frames.values()} == {(0, 0)}
    assert {frames[0x300 + node][0] for nodes in arm.nodes for node in nodes} == {20}


@pytest.mark.parametrize("together", [True, False])
def test_what_is_sent_on_a_bus_before_its_first_sync_is_heard_before_it(together: bool) -> None:
    run = arm9()
    sensor, plant = run.robot.description.force_torque_sensors[0], Arm(run).plant
    bus = run.robot.description.bus_index(sensor.bus)
    start = pack(sensor.command_id, b"\x0b" + bytes(7))
    plant.deliver(0, SYNC)  # the other buses may be ahead
    for packet in [start + SYNC] if together else [start, SYNC]:
        answers = dict(unpack(plant.deliver(bus, packet)))
    assert {sensor.can_id, sensor.can_id + 1} <= set(answers)


def test_it_does_not_matter_whether_a_command_is_read_before_another_bus_has_its_sync() -> None:
    observed = []
    for early in (True, False):
        arm = Arm(arm9(compute_budget_s=0.0015))
        arm.sync()
        data = struct.pack("<Hbh", 0x0F, 10, 0)
        commands = [b"".join(pack(0x300 + node, data) for node in nodes) for nodes in arm.nodes]
        arm.plant.deliver(0, commands[0])
        if early:
            arm.plant.deliver(1, commands[1])
        arm.plant.deliver(0, SYNC)
        if not early:
            arm.plant.deliver(1, commands[1])
        observed.append((dict(unpack(arm.plant.deliver(1, SYNC))), arm.frames()))
    assert observed[0] == observed[1]


@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_how_commands_are_cut_into_packets_does_not_matter_on_an_overloaded_bus(size: int) -> None:
    """A kernel interface gives them one by one, a virtual bus as many as wait: they contend all the same."""

    def observe(size: int) -> object:
        arm = Arm(on_one_bus())
        seen = arm.sync()
        for per_mille in range(5):
            data = struct.pack("<Hbh", 0x0F, 10, per_mille)
            frames = [pack(0x300 + node, data) for node in reversed(arm.nodes[0])]
            for begin in range(0, len(frames), size):
                arm.plant.deliver(0, b"".join(frames[begin : begin + size]))
            seen += arm.sync()
        return seen, arm.plant.statistics(final=True)

    assert observe(size) == observe(9)


def test_heartbeats_that_do_not_fit_before_the_commands_yield_to_them() -> None:
    """The drives' heartbeats are due at one time; of those that wait when commands are ready one at most goes first."""
    arm = Arm(arm9(compute_budget_s=1e-6))
    for bus, nodes in enumerate(arm.nodes):
        for node in nodes:
            request = struct.pack("<BHBI", 0x2B, 0x1017, 0, 10)
            arm.plant.deliver(bus, pack(0x600 + node, request))
    for _ in range(20):
        arm.sync()
        arm.command()
    messages = arm.plant.statistics(final=True)
    frames = {frame.can_id: frame for message in messages for frame in message.frames}
    assert all(frames[0x700 + node].frames >= 3 for nodes in arm.nodes for node in nodes)
    for nodes in arm.nodes:
        assert frames[0x300 + min(nodes)].wait_max_s <= 65e-6


def test_a_bus_that_is_down_is_not_waited_for_and_its_drives_hold() -> None:
    arm = Arm(arm9())
    arm.sync()
    arm.command()
    arm.sync()
    arm.plant.set_bus_down(0, True)
    for _ in range(8):
        for bus in (1, 2):
            assert not arm.plant.sync_complete
            arm.plant.deliver(bus, SYNC)
        assert arm.plant.sync_complete
        arm.plant.advance()
        for bus in (1, 2):
            data = struct.pack("<Hbh", 0x0F, 10, 0)
            arm.plant.deliver(bus, b"".join(pack(0x300 + node, data) for node in arm.nodes[bus]))
    held = {drive.node_id for drive in arm.plant.drives if drive.power.left_alone}
    assert held == set(arm.nodes[0])
    arm.plant.set_bus_down(0, False)
    assert set(arm.sync()[0]) >= {0x180 + node for node in arm.nodes[0]}


def test_a_bus_that_comes_back_does_not_pour_out_the_heartbeats_of_the_outage() -> None:
    arm = Arm(arm9())
    for node in arm.nodes[0]:
        arm.plant.deliver(0, pack(0x600 + node, struct.pack("<BHBI", 0x2B, 0x1017, 0, 10)))
    arm.sync()
    arm.plant.set_bus_down(0, True)
    for _ in range(200):
        for bus in (1, 2):
            arm.plant.deliver(bus, SYNC)
        arm.plant.advance()
    arm.plant.set_bus_down(0, False)
    answers = [can_id for can_id, _ in unpack(arm.plant.deliver(0, SYNC))]
    assert {0x700 + node for node in arm.nodes[0]} <= set(answers)
    assert max(answers.count(0x700 + node) for node in arm.nodes[0]) == 1


def test_in_real_time_answers_come_when_the_bus_has_carried_them() -> None:
    arm = Arm(arm9(), free=True)
    plant, reports = arm.plant, {0x180 + node for node in arm.nodes[0]}
    plant.pump(PERIOD_NS)
    plant.advance()
    plant.deliver(0, SYNC, 100_000)
    assert plant.busy_ns is not None
    assert not reports & set(dict(unpack(plant.pump(140_000)[0])))  # the SYNC itself takes 50 µs
    early = reports & set(dict(unpack(plant.pump(300_000)[0])))
    assert early < reports
    assert early | set(dict(unpack(plant.pump(1_500_000)[0]))) >= reports
    assert plant.busy_ns is None


def test_on_a_real_wire_frames_take_the_time_that_they_take() -> None:
    buses = tuple(bus.model_copy(update={"interface": "socketcan"}) for bus in arm9().robot.description.buses)
    arm = Arm(arm9(buses=buses), free=True)
    arm.plant.advance()
    answers = dict(unpack(arm.plant.deliver(0, SYNC, 100_000)))
    assert set(answers) >= {0x180 + node for node in arm.nodes[0]}
    assert arm.plant.statistics(final=True) == ()
