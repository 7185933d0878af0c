"""arm9: inertials that follow from its primitives, a firmware that carries the arm, a bus plan that fits."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pinocchio as pin
import pytest

from schemas.bus_load import bus_loads
from schemas.load import load_robot

ROBOT = load_robot("arm9")
JOINTS = ROBOT.description.joints
LINKS = ElementTree.fromstring(ROBOT.urdf).findall("link")


def numbers(element: ElementTree.Element, name: str) -> list[float]:
    return [float(number) for number in element.attrib.get(name, "0 0 0").split()]


def solid_inertia(collision: ElementTree.Element, mass: float) -> np.ndarray:
    """Moments of inertia of a homogeneous primitive about its centre, turned into the link's axes."""
    shape = collision.find("geometry")[0]
    if shape.tag == "box":
        squares = np.square(numbers(shape, "size"))
        moments = mass / 12.0 * (squares.sum() - squares)
    elif shape.tag == "sphere":
        moments = np.full(3, 0.4 * mass * float(shape.get("radius")) ** 2)
    else:
        radius, length = float(shape.get("radius")), float(shape.get("length"))
        across = mass * (3.0 * radius**2 + length**2) / 12.0
        moments = np.array([across, across, mass * radius**2 / 2.0])
    rotation = pin.rpy.rpyToMatrix(*numbers(collision.find("origin"), "rpy"))
    return rotation @ np.diag(moments) @ rotation.T


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link.get("name"))
def test_inertials_are_those_of_the_primitive(link: ElementTree.Element) -> None:
    inertial, collision = link.find("inertial"), link.find("collision")
    stated = inertial.find("inertia").attrib
    matrix = np.array([[float(stated["i" + "".join(sorted(a + b))]) for b in "xyz"] for a in "xyz"])
    expected = solid_inertia(collision, float(inertial.find("mass").get("value")))
    assert matrix == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert numbers(inertial.find("origin"), "xyz") == numbers(collision.find("origin"), "xyz")


def test_size_of_an_hrp5p_arm() -> None:
    model = pin.buildModelFromXML(ROBOT.urdf)
    assert model.nv == 9
    assert pin.computeTotalMass(model) == pytest.approx(15.3)
    offsets = [np.linalg.norm(placement.translation) for placement in list(model.jointPlacements)[3:]]
    hand = model.frames[model.getFrameId("hand")].placement.translation
    assert 0.95 <= sum(offsets) + np.linalg.norm(hand) <= 1.05


def test_position_loop_carries_the_worst_pose() -> None:
    """Sag below 0.15° with masses 10 % too large and motors 10 % too weak; no joint nearly overloaded."""
    model = pin.buildModelFromXML(ROBOT.urdf)
    data = model.createData()
    generator = np.random.default_rng(0)
    gravity = np.zeros(9)
    for _ in range(1000):
        q = generator.uniform([j.position_min for j in JOINTS], [j.position_max for j in JOINTS])
        gravity = np.maximum(gravity, np.abs(pin.computeGeneralizedGravity(model, data, q)))
    stiffness = np.array([joint.drive.position_gain for joint in JOINTS])
    dead_zone = np.array([joint.drive.dead_zone for joint in JOINTS])
    sag = (1.1 / 0.9 * gravity + dead_zone) / stiffness
    assert np.rad2deg(sag).max() < 0.15
    assert (gravity < 0.25 * np.array([joint.torque_limit for joint in JOINTS])).all()


@pytest.mark.parametrize("joint", JOINTS, ids=lambda joint: joint.name)
def test_servo_is_plausible_and_resolution_fine(joint) -> None:
    armature = joint.rotor_inertia * joint.gear_ratio**2
    assert 0.5 <= armature <= 5.0
    assert 200 <= joint.gear_ratio <= 300
    assert 0.005 <= joint.drive.dead_zone / joint.torque_limit <= 0.01
    assert joint.drive.rated_motor_torque * joint.gear_ratio <= joint.torque_limit
    # The firmware's damping must stay explicit-stable on the bare rotor at half a millisecond.
    assert joint.drive.velocity_gain * 0.0005 / armature < 0.5


@pytest.mark.parametrize("joint", JOINTS, ids=lambda joint: joint.name)
def test_limits_lie_inside_the_stops_of_the_urdf(joint) -> None:
    limit = next(
        element.find("limit").attrib
        for element in ElementTree.fromstring(ROBOT.urdf).findall("joint")
        if element.get("name") == joint.name
    )
    assert float(limit["lower"]) < joint.position_min < joint.position_max < float(limit["upper"])
    assert float(limit["effort"]) == joint.torque_limit
    assert float(limit["velocity"]) == joint.velocity_limit


def test_every_bus_fits_its_period() -> None:
    robot = ROBOT.description
    for load in bus_loads(robot):
        assert load.fraction < 1.0
        assert load.report_time_s + robot.compute_budget_s + load.command_time_s <= robot.period_s
