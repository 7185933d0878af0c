"""Every message survives the way through its JSON; nothing else passes for one."""

from __future__ import annotations

import json
from typing import Any, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.base import ControlMode, Model
from schemas.messages import (
    AppliedCommand,
    BusFrames,
    BusStatistics,
    ContactSample,
    ControllerTrace,
    CycleStatistics,
    DriveState,
    Event,
    FrameStatistics,
    HalStatus,
    ImuSample,
    JointCommand,
    MotionTrace,
    OffsetTrace,
    OperatorRequest,
    PlantTruth,
    PoseSample,
    RobotState,
    WrenchSample,
)
from schemas.topics import TOPICS, MalformedMessageError, decode, encode, stamp, topics_of

numbers = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.lists(numbers, min_size=2, max_size=2).map(tuple)
triples = st.tuples(numbers, numbers, numbers)
quaternions = st.tuples(numbers, numbers, numbers, numbers)
sequences = st.integers(-1, 2**40)
times = st.integers(0, 2**62)
poses = st.builds(PoseSample, position_in_world=triples, orientation_to_world=quaternions)
names = st.text(max_size=12)
modes = st.sampled_from(ControlMode)
applied = st.builds(AppliedCommand, sequence=sequences, mode=modes, position=st.none() | vectors, torque=vectors)
estimates = st.builds(
    MotionTrace,
    delay_s=numbers,
    **{name: vectors for name in MotionTrace.model_fields if name != "delay_s"},
)
offsets = st.builds(
    OffsetTrace,
    **{name: vectors for name in OffsetTrace.model_fields if name != "limited"},
    limited=st.lists(names, max_size=2).map(tuple),
)
common: dict[str, Any] = {"sequence": sequences, "time_ns": times}
MESSAGES: dict[type[Model], st.SearchStrategy[Model]] = {
    RobotState: st.builds(
        RobotState,
        **common,
        status=st.sampled_from(HalStatus),
        position_measured=vectors,
        motor_torque_measured=st.none() | vectors,
        drive_state=st.lists(st.sampled_from(DriveState), max_size=2).map(tuple),
        mode=st.lists(modes, max_size=2).map(tuple),
        error_code=st.just((0, 0x8611)),
        applied=applied,
        wrenches=st.lists(
            st.builds(WrenchSample, name=names, force_in_sensor=triples, torque_in_sensor=triples), max_size=1
        ).map(tuple),
        imus=st.lists(
            st.builds(
                ImuSample,
                name=names,
                angular_velocity_in_imu=triples,
                acceleration_in_imu=triples,
                orientation_imu_to_world=quaternions,
            ),
            max_size=1,
        ).map(tuple),
    ),
    JointCommand: st.builds(JointCommand, **common, session=names, mode=modes, position=vectors, torque=vectors),
    ControllerTrace: st.builds(
        ControllerTrace,
        **common,
        phase=names,
        mode=modes,
        **{
            name: vectors
            for name, field in ControllerTrace.model_fields.items()
            if get_args(field.annotation) == (float, Ellipsis)
        },
        hand_desired=st.none() | poses,
        hand_estimated=st.none() | poses,
        qp_iterations=st.integers(0, 200),
        qp_primal_residual=numbers,
        qp_dual_residual=numbers,
        qp_status=names,
        estimated=st.none() | estimates,
        offset=st.none() | offsets,
    ),
    PlantTruth: st.builds(
        PlantTruth,
        **common,
        position=vectors,
        velocity=vectors,
        acceleration=vectors,
        mode=st.just((8, 10)),
        drive_state=st.just((DriveState.OPERATION_ENABLED, DriveState.FAULT)),
        motor_torque=vectors,
        motor_torque_substeps=st.lists(vectors, max_size=3).map(tuple),
        friction_torque=vectors,
        frames=st.dictionaries(names, poses, max_size=2),
        sensor_wrenches=st.dictionaries(names, st.tuples(triples, triples), max_size=1),
        contacts=st.lists(
            st.builds(ContactSample, link=names, other=names, force_in_world=triples, position_in_world=triples),
            max_size=2,
        ).map(tuple),
        world_forces=st.dictionaries(names, triples, max_size=2),
    ),
    BusFrames: st.builds(BusFrames, **common, bus=names, sent=st.binary(max_size=64), received=st.binary(max_size=64)),
    Event: st.builds(
        Event,
        **common,
        service=names,
        kind=names,
        severity=st.sampled_from(["info", "warning", "error"]),
        text=names,
        joint=st.none() | names,
    ),
    CycleStatistics: st.builds(
        CycleStatistics,
        **common,
        service=names,
        cycles=st.integers(0, 10**6),
        cycle_time_median_s=numbers,
        cycle_time_p99_s=numbers,
        cycle_time_max_s=numbers,
        cycle_time_counts=st.lists(st.tuples(st.integers(-100, 900), st.integers(1, 10**6)), max_size=4).map(tuple),
        real_time_factor=numbers,
    ),
    OperatorRequest: st.builds(OperatorRequest, action=st.sampled_from(["stop", "reset"]), reason=names),
    BusStatistics: st.builds(
        BusStatistics,
        **common,
        bus=names,
        cycles=sequences,
        load_mean=numbers,
        load_max=numbers,
        report_end_max_s=numbers,
        command_end_max_s=numbers,
        frames=st.lists(st.builds(FrameStatistics, can_id=sequences, frames=sequences), max_size=2).map(tuple),
    ),
}


@pytest.mark.parametrize("model", MESSAGES, ids=lambda model: model.__name__)
def test_round_trip(model: type[Model]) -> None:
    @settings(max_examples=25, deadline=None, database=None)
    @given(MESSAGES[model])
    def check(message: Model) -> None:
        data = encode(message)
        assert decode(model, data) == message
        assert encode(decode(model, data)) == data

    check()


def _fields(model: type[Model]) -> dict[str, Any]:
    return json.loads(encode(_example(model)))


def _example(model: type[Model]) -> Model:
    found: list[Model] = []

    @settings(max_examples=1, database=None, derandomize=True, deadline=None)
    @given(MESSAGES[model])
    def take(message: Model) -> None:
        found.append(message)

    take()
    return found[0]


def _floats(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(value, float):
        return [path]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, item in items for found in _floats(item, (*path, key))]


@pytest.mark.parametrize("model", MESSAGES, ids=lambda model: model.__name__)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_nothing_but_finite_numbers_in_any_field(model: type[Model], bad: float) -> None:
    fields = _fields(model)
    for path in _floats(fields):
        broken = json.loads(json.dumps(fields))
        node = broken
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = bad
        with pytest.raises(MalformedMessageError, match=rf"{model.__name__}: {path[0]}.*finite number"):
            decode(model, json.dumps(broken).encode())


@pytest.mark.parametrize("model", MESSAGES, ids=lambda model: model.__name__)
def test_unknown_missing_and_garbage_are_refused(model: type[Model]) -> None:
    fields = _fields(model)
    with pytest.raises(MalformedMessageError, match="colour: Extra inputs"):
        decode(model, json.dumps(fields | {"colour": 1}).encode())
    first = next(iter(fields))
    with pytest.raises(MalformedMessageError, match=f"{first}: Field required"):
        decode(model, json.dumps({key: value for key, value in fields.items() if key != first}).encode())
    for garbage in (b"", b"\xff\xfe", b"{", b"null", b"[]"):
        with pytest.raises(MalformedMessageError, match=f"{model.__name__}: message"):
            decode(model, garbage)


def test_messages_are_frozen() -> None:
    request = OperatorRequest(action="stop")
    with pytest.raises(ValueError, match="frozen"):
        request.action = "reset"  # type: ignore[misc]  # that is the point


def test_every_topic_has_a_message_and_every_message_a_topic(run: Any) -> None:
    topics = topics_of(run.robot.description)
    assert set(topics.values()) == set(MESSAGES)
    assert list(topics) == [*TOPICS, "bus/can0", "bus/can1", "load/can0", "load/can1"]


def test_stamp_is_sequence_and_time() -> None:
    assert stamp(_example(Event)) == (_example(Event).sequence, _example(Event).time_ns)  # type: ignore[attr-defined]
    assert stamp(OperatorRequest(action="stop")) == (0, 0)
