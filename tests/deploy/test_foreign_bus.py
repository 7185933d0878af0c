"""Programs that are not ours on the plant's buses: a CANopen master, a CAN logger."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from deploy.session import free_base_port
from hal.profile.objects import eds_path
from tests.deploy.running import cosim_up

pytestmark = [pytest.mark.processes, pytest.mark.timeout(120)]
NODE = 6
"""elbow_pitch of arm9, on the second bus; its torque limit is 1800 ‰ of rated."""
PATIENCE_S = 20.0


def wait_for(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of arm9's second bus, hosted by `cosim plant --clock realtime` without any other service."""
    directory = tmp_path_factory.mktemp("plant")
    line = ["plant", "--scenario", "arm9-transition", "--clock", "realtime", "--base-port", str(free_base_port())]
    environment = {**os.environ, "COSIM_RUN_DIR": str(directory)}
    process = subprocess.Popen([sys.executable, "-m", "deploy.cli", *line], env=environment)
    try:
        path = directory / "arm9-1"
        assert wait_for(path.exists)
        yield path
        process.terminate()
        assert process.wait(5.0) == 0
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


@contextmanager
def operated(channel: Path, target: int, cycle_s: float) -> Iterator[BaseNode402]:
    """A node with the set-point `target` in RPDO1 and SYNC on its bus alone, at a rate that is not the robot's."""
    network = canopen.Network()
    network.connect(interface="cosim", channel=str(channel))
    node = BaseNode402(NODE, eds_path())
    network.add_node(node)
    try:
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[0x1006].raw = round(cycle_s * 1e6)
        node.sdo[0x2004].raw = 200
        node.rpdo[1].read()
        node.rpdo[1].clear()
        for index in (0x6040, 0x6060, target):
            node.rpdo[1].add_variable(index)
        node.rpdo[1].save()
        node.setup_402_state_machine()
        node.nmt.state = "OPERATIONAL"
        network.sync.start(cycle_s)
        node.rpdo[1][target].raw = node.sdo[0x6064].raw if target == 0x607A else 0
        node.rpdo[1].start(cycle_s)
        yield node
    finally:
        node.state = "SWITCH ON DISABLED"  # the next master must not take this one's drive for its own
        node.rpdo[1].stop()
        network.sync.stop()
        node.nmt.state = "PRE-OPERATIONAL"
        network.disconnect()


@pytest.mark.parametrize("cycle_s", [0.005, 0.013])
def test_a_foreign_master_moves_a_joint_in_position_mode(bus: Path, cycle_s: float) -> None:
    with operated(bus, 0x607A, cycle_s) as node:
        node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
        node.state = "OPERATION ENABLED"
        assert (node.state, node.op_mode) == ("OPERATION ENABLED", "CYCLIC SYNCHRONOUS POSITION")
        start = node.sdo[0x6064].raw
        for step in range(20):
            node.rpdo[1][0x607A].raw = start + 500 * (step + 1)  # 1024000 counts are a turn of the joint
            time.sleep(cycle_s)
        assert wait_for(lambda: abs(node.tpdo[1][0x6064].raw - start - 10_000) < 1000)
        node.rpdo[1][0x607A].raw = start
        assert wait_for(lambda: abs(node.tpdo[1][0x6064].raw - start) < 1000)


def test_a_foreign_master_moves_a_joint_in_torque_mode(bus: Path) -> None:
    with operated(bus, 0x6071, 0.01) as node:
        node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
        node.state = "OPERATION ENABLED"
        assert (node.state, node.op_mode) == ("OPERATION ENABLED", "CYCLIC SYNCHRONOUS TORQUE")
        start = node.tpdo[1][0x6064].raw
        node.rpdo[1][0x6071].raw = -500  # half the rated torque, far above friction
        assert wait_for(lambda: node.tpdo[1][0x6064].raw < start - 1000)
        assert -500 < node.tpdo[1][0x6077].raw < -450  # less the current's dead zone
        node.rpdo[1][0x6071].raw = 0


def test_a_can_logger_hears_a_running_robot(tmp_path: Path) -> None:
    trace = tmp_path / "trace.log"
    with cosim_up(tmp_path, "arm9-transition", "--duration", "60") as running:
        running.wait_for_sequence(50)
        session = running.session()
        # As `python -m can.logger`, with the Ctrl-C that a program started in the background lacks.
        heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
        module = "import runpy; runpy.run_module('can.logger', run_name='__main__')"
        line = ["-c", f"{heed}; {module}", "-i", "cosim", "-c", f"{session.directory}/arm9-1", "-f", str(trace)]
        logger = subprocess.Popen([sys.executable, *line], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            assert wait_for(lambda: trace.exists() and trace.stat().st_size > 4000)
        finally:
            logger.send_signal(signal.SIGINT)
            logger.wait(10.0)
        before = running.wait_for_sequence(0).sequence
        assert running.wait_for_sequence(before + 20).sequence >= before + 20
    heard = {message.arbitration_id for message in can.LogReader(str(trace))}
    assert heard >= {0x080, 0x184, 0x185, 0x186, 0x204}
