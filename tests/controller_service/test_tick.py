"""Events: each told once as it begins, a limit that stays relaxed once a second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_service.acceleration_qp import ReferenceMotion
from controller_service.contact import ContactState
from controller_service.dual_compliance import Compliance
from controller_service.force_tasks import WrenchReference
from controller_service.hand_control import HandForces
from controller_service.law import LawTerms
from controller_service.model import RobotModel
from controller_service.qp import QpSolution
from controller_service.tick import EventLog, Tick
from controller_service.torque_mode import Sensed, TorqueTick
from controller_service.wrench import HandWrench
from schemas.base import ControlMode
from schemas.load import Robot
from schemas.messages import AppliedCommand, DriveState, Event, HalStatus, RobotState

PERIOD_NS = 2_000_000
ZERO = np.zeros(9)
SOLVED = QpSolution(ZERO, np.zeros(18), 1, "solved", 0.0, 0.0)
QUIET = ContactState(active=False, began=False, ended=False, joint=0, value=0.0)
OFF = Compliance(active=False, engaged=False, released=False)


def state(sequence: int) -> RobotState:
    return RobotState(
        sequence=sequence,
        time_ns=sequence * PERIOD_NS,
        status=HalStatus.ACTIVE,
        position_measured=(0.0,) * 9,
        motor_torque_measured=None,
        drive_state=(DriveState.OPERATION_ENABLED,) * 9,
        mode=(ControlMode.TORQUE,) * 9,
        error_code=(0,) * 9,
        applied=AppliedCommand(sequence=-1, mode=ControlMode.TORQUE),
    )


@pytest.fixture
def tick(arm: Robot) -> Tick:
    now = RobotModel(arm).configure(ZERO, ZERO)
    forces = HandForces(
        HandWrench(np.array([3.0, 0.0, 4.0, 0.0, 0.0, 0.0]), np.zeros(6), 0), WrenchReference.zero(), OFF, False
    )
    law = LawTerms(ZERO, ZERO, ZERO, ZERO, ZERO, 0.0)
    motion = ReferenceMotion(ZERO, None, SOLVED)
    terms = TorqueTick(Sensed(ZERO, QUIET, forces), motion, ZERO, law, ZERO)
    return Tick(ControlMode.TORQUE, now, motion, ZERO, ZERO, None, ZERO, terms)


def relaxing(tick: Tick, *names: str) -> Tick:
    return replace(tick, motion=replace(tick.motion, relaxed=names))


def sensing(tick: Tick, contact: ContactState = QUIET, compliance: Compliance = OFF) -> Tick:
    assert tick.terms is not None
    hand = tick.terms.sensed.hand
    assert hand is not None
    sensed = Sensed(ZERO, contact, replace(hand, compliance=compliance))
    return replace(tick, terms=replace(tick.terms, sensed=sensed))


def told(log: EventLog) -> list[tuple[int, str]]:
    return [(event.sequence, event.text) for event in log.drain()]


def test_a_limit_that_stays_relaxed_is_told_once_a_second(arm: Robot, tick: Tick) -> None:
    log, text = (
        EventLog(arm.description.joint_names),
        "range or speed of joint5: cannot be kept with the torque there is",
    )
    for sequence in range(1, 1400):
        log.note(state(sequence), relaxing(tick, "range or speed of joint5"))
    assert told(log) == [(1, text), (501, text), (1001, text)]


def test_each_limit_has_its_own_second_and_coming_and_going_makes_no_more_of_it(arm: Robot, tick: Tick) -> None:
    log = EventLog(arm.description.joint_names)
    for sequence in range(900):
        names = ["distance post to palm"] if sequence % 2 else []
        log.note(state(sequence), relaxing(tick, *names, *(["range or speed of joint2"] if sequence >= 300 else [])))
    assert [(at, text.split(":")[0]) for at, text in told(log)] == [
        (1, "distance post to palm"),
        (300, "range or speed of joint2"),
        (501, "distance post to palm"),
        (800, "range or speed of joint2"),
    ]
    log.note(state(900), relaxing(tick))
    assert not log.drain()


def test_limits_relaxed_in_position_mode_are_told_too(arm: Robot, tick: Tick) -> None:
    log = EventLog(arm.description.joint_names)
    log.note(state(3), replace(relaxing(tick, "range or speed of joint0"), terms=None))
    (event,) = log.drain()
    assert (event.kind, event.severity, event.service, event.time_ns) == (
        "constraint_relaxed",
        "warning",
        "controller",
        3 * PERIOD_NS,
    )


def edge(began: bool) -> ContactState:
    return ContactState(active=began, began=began, ended=not began, joint=5, value=-31.4)


def test_contacts_and_admittance_are_told_at_their_edges(arm: Robot, tick: Tick) -> None:
    log, events = EventLog(arm.description.joint_names), dict[str, Event]()
    lasting = ContactState(active=True, began=False, ended=False, joint=5, value=-31.4)
    giving_way = Compliance(active=True, engaged=False, released=False)
    ticks = (
        sensing(tick),
        sensing(tick, edge(began=True), replace(giving_way, engaged=True)),
        sensing(tick, lasting, giving_way),
        sensing(tick, edge(began=False), Compliance(active=False, engaged=False, released=True)),
        sensing(tick),
    )
    for sequence, one in enumerate(ticks):
        log.note(state(sequence), one)
    events = {event.kind: event for event in log.drain()}
    assert {kind: event.sequence for kind, event in events.items()} == {
        "contact": 1,
        "admittance_on": 1,
        "contact_ended": 3,
        "admittance_off": 3,
    }
    assert (events["contact"].joint, events["contact"].severity) == ("joint5", "warning")
    assert "joint5 feels -31.4 N·m" in events["contact"].text
    assert "5.0 N" in events["admittance_on"].text


def test_where_contacts_are_not_to_be_told_the_rest_still_is(arm: Robot, tick: Tick) -> None:
    log = EventLog(arm.description.joint_names, contacts=False)
    log.note(state(0), sensing(tick, edge(began=True), Compliance(active=True, engaged=True, released=False)))
    log.note(state(1), sensing(tick, edge(began=False)))
    assert [event.kind for event in log.drain()] == ["admittance_on"]


def test_events_are_drained_once(arm: Robot, tick: Tick) -> None:
    log = EventLog(arm.description.joint_names)
    log.note(state(0), relaxing(tick, "range or speed of joint0"))
    assert len(log.drain()) == 1
    assert not log.drain()
