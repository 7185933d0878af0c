from __future__ import annotations

import os
import socket
import time
from dataclasses import replace
from pathlib import Path

import pytest

from deploy import session
from deploy.cli import main as cli
from deploy.errors import LaunchError, UsageError
from deploy.launcher import LOG_NAME, output_directory, plan
from deploy.run_file import read_run, write_run
from deploy.services import arguments, main, said_by
from schemas.errors import ConfigurationError
from schemas.load import Run, load_run
from schemas.service import Service, session_identity


def test_identity_depends_on_scenario_and_seed_alone(run: Run) -> None:
    assert session_identity(run) == session_identity(load_run("arm9-transition", {"duration_s": 1.0}))
    assert session_identity(run) != session_identity(load_run("arm9-transition", {"duration_s": 1.0, "seed": 1}))


def test_run_file_round_trip(run: Run, tmp_path: Path) -> None:
    write_run(run, tmp_path / "run.json")
    assert read_run(tmp_path / "run.json") == run


def test_services_take_a_forced_run_from_the_run_file(tmp_path: Path) -> None:
    run = load_run("arm9-transition", {"robot.compute_budget_s": 0.0015, "allow_overload": True})
    write_run(run, tmp_path / "run.json")
    assert read_run(tmp_path / "run.json") == run


@pytest.mark.parametrize("text", ["", "{}", '{"robot": 1}', "[1, 2]"])
def test_a_bad_run_file_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.json"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=r"run\.json"):
        read_run(path)
    line = ["hal", "--run-file", str(path), "--base-port", "20000", "--session", "x", "--run-directory", str(tmp_path)]
    assert main(line) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_service_names_itself_once() -> None:
    assert said_by(Service.HAL, "no drive answers") == "hal: no drive answers"
    assert said_by(Service.HAL, "hal: no drive answers") == "hal: no drive answers"


def test_a_plan_gives_an_output_to_the_recorder_alone(run: Run, runtime: Path, tmp_path: Path) -> None:
    prepared = plan(run, tmp_path)
    assert prepared.options.peers == ("plant", "hal", "controller", "recorder")
    outputs = {service: prepared.options_of(service).output for service in Service}
    assert outputs == dict.fromkeys(Service) | {Service.RECORDER: tmp_path / LOG_NAME}
    assert "--output" in arguments(Service.RECORDER, tmp_path / "run.json", prepared.options_of(Service.RECORDER))


def test_a_real_robot_has_no_plant(run: Run, runtime: Path, tmp_path: Path) -> None:
    assert plan(run, tmp_path, with_plant=False).options.peers == ("hal", "controller", "recorder")


def test_ports_in_use_are_passed_over() -> None:
    first = session.free_base_port()
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of an earlier run may linger
        taken.bind(("127.0.0.1", first + 1))
        taken.listen()
        assert not first <= session.free_base_port() < first + session.PORTS


def test_a_run_directory_too_long_for_sockets_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSIM_RUN_DIR", str(tmp_path / ("x" * 90)))
    with pytest.raises(LaunchError, match="COSIM_RUN_DIR"):
        session.run_directory(20000)


def test_a_running_session_is_found_until_it_ends(run: Run, runtime: Path, tmp_path: Path) -> None:
    prepared = plan(run, tmp_path, base_port=20480)
    note = session.describe(run, prepared.options, tmp_path)
    session.announce(note)
    assert session.choose_session(None) == note
    assert session.choose_session(20480) == note
    with pytest.raises(UsageError, match="20481"):
        session.choose_session(20481)
    session.announce(replace(note, pid=2**22 + 1))
    assert session.running_sessions() == []
    session.discard(prepared.options.run_directory)
    assert not prepared.options.run_directory.exists()


def test_two_runs_ask_for_a_choice(run: Run, runtime: Path, tmp_path: Path) -> None:
    for port in (20480, 20490):
        session.announce(session.describe(run, plan(run, tmp_path, base_port=port).options, tmp_path))
    with pytest.raises(UsageError, match=f"20480.*process {os.getpid()}.*20490"):
        session.choose_session(None)


def test_an_existing_log_is_not_overwritten(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    now = time.gmtime(0)
    first = output_directory(run, None, now)
    (first / LOG_NAME).touch()
    second = output_directory(run, None, now)
    assert second != first
    with pytest.raises(UsageError, match="exists"):
        output_directory(run, first, now)


def test_notes_of_two_robots_lie_side_by_side(run: Run, runtime: Path, tmp_path: Path) -> None:
    options = plan(run, tmp_path, base_port=20480).options
    # Robots started service by service share the directory of bare bus channels.
    notes = [
        session.describe(run, replace(options, base_port=port, run_directory=session.runtime_root()), tmp_path)
        for port in (20480, 20490)
    ]
    for note in notes:
        session.announce(note)
    assert session.running_sessions() == notes
    session.withdraw(notes[0])
    assert session.running_sessions() == notes[1:]


def test_the_ports_of_a_run_are_refused_and_its_files_stay(
    run: Run, runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = plan(run, tmp_path, base_port=20480)
    other = replace(session.describe(run, prepared.options, tmp_path), pid=os.getppid())
    session.announce(other)
    socket_file = prepared.options.run_directory / "can0"
    socket_file.touch()
    with pytest.raises(UsageError, match=rf"20480: taken by {run.scenario.name} \(process {os.getppid()}\)"):
        plan(run, tmp_path, base_port=20480)
    monkeypatch.setattr("deploy.services.run_service", lambda *_: 0)
    assert cli(["hal", "--scenario", "arm9-transition", "--base-port", "20480"]) == 2
    assert session.running_sessions() == [other]
    assert socket_file.exists()
    assert plan(run, tmp_path, base_port=20490).options.base_port == 20490
