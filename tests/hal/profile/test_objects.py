from __future__ import annotations

import canopen
import pytest

from hal.profile import objects
from hal.profile.objects import RPDOS, TPDO_MODE, TPDO_STATE, Pdo, eds_path


@pytest.fixture(scope="module")
def dictionary() -> canopen.ObjectDictionary:
    return canopen.import_od(eds_path(), node_id=5)


def test_mappings_are_those_of_the_standard() -> None:
    assert TPDO_STATE.entries == (0x60410010, 0x60640020, 0x60770010)
    assert TPDO_MODE.entries == (0x60610008, 0x603F0010)
    assert [pdo.entries for pdo in RPDOS["torque"]] == [
        (0x60400010, 0x60600008, 0x607A0020),
        (0x60400010, 0x60600008, 0x60710010),
    ]
    assert [pdo.entries for pdo in RPDOS["servo"]] == [(0x60400010, 0x607A0020, 0x60720010)]
    assert RPDOS["position_pd"] == RPDOS["torque"][:1]


def test_sizes_agree_with_the_layouts() -> None:
    position, torque = RPDOS["torque"]
    (servo,) = RPDOS["servo"]
    rows = [
        (TPDO_STATE, objects.STATE_STRUCT, objects.STATE_LAYOUT, 8),
        (TPDO_MODE, objects.MODE_STRUCT, objects.MODE_LAYOUT, 3),
        (position, objects.POSITION_STRUCT, objects.POSITION_LAYOUT, 7),
        (torque, objects.TORQUE_STRUCT, objects.TORQUE_LAYOUT, 5),
        (servo, objects.SERVO_STRUCT, objects.SERVO_LAYOUT, 8),
    ]
    for pdo, packer, layout, size in rows:
        assert pdo.size == packer.size == layout.itemsize == size


@pytest.mark.parametrize(
    ("pdo", "communication", "mapping"),
    [
        (RPDOS["torque"][0], 0x1400, 0x1600),
        (RPDOS["torque"][1], 0x1401, 0x1601),
        (TPDO_STATE, 0x1800, 0x1A00),
        (TPDO_MODE, 0x1801, 0x1A01),
    ],
)
def test_the_eds_holds_the_profiles_pdos(
    dictionary: canopen.ObjectDictionary, pdo: Pdo, communication: int, mapping: int
) -> None:
    assert dictionary[communication][1].default & 0x7FF == pdo.cob_id(5)
    # The factory setting of the mode report repeats it every 100 ms, for masters that poll by PDO; the boot sets ours.
    factory = (255, 100) if pdo is objects.TPDO_MODE else (pdo.transmission_type, 0)
    assert (dictionary[communication][2].default, dictionary[communication][5].default) == factory
    count = dictionary[mapping][0].default
    assert tuple(dictionary[mapping][sub].default for sub in range(1, count + 1)) == pdo.entries
    for mapped in pdo.entries:
        variable = dictionary[mapped >> 16]
        assert variable.pdo_mappable
        assert len(variable) == mapped & 0xFF


def test_every_named_object_is_in_the_eds(dictionary: canopen.ObjectDictionary) -> None:
    for name, index in vars(objects).items():
        if name.isupper() and isinstance(index, int):
            assert index in dictionary, name


def test_defaults_of_the_eds(dictionary: canopen.ObjectDictionary) -> None:
    assert dictionary[0x1000].default == 0x00020192
    assert dictionary[0x1014].default == 0x85
    assert dictionary[0x6502].default == 0x280
    assert dictionary[0x6065].default == 0xFFFFFFFF
    assert dictionary[0x607D][1].default == -(2**31)
    assert (dictionary[0x60C2][1].default, dictionary[0x60C2][2].default) == (1, -3)
    assert not dictionary[0x6041].writable
    assert dictionary[0x6040].writable
