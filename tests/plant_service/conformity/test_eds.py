"""Identity (CiA 301 7.5.2.1, 7.5.2.19) and the EDS (CiA 306): what it promises is what the device does."""

from __future__ import annotations

import configparser
import struct

import canopen
import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable

from hal.profile.objects import eds_path

FORMATS = {0x02: "<b", 0x03: "<h", 0x04: "<i", 0x05: "<B", 0x06: "<H", 0x07: "<I"}
"""CiA 301 table 44: INTEGER8 to 32, UNSIGNED8 to 32. 0009h is VISIBLE_STRING."""
LIVE = {0x6041, 0x6064, 0x6077, 0x606C}
"""Objects whose value is measured."""
ORDER = {0x1400: 0x1600, 0x1401: 0x1601, 0x1800: 0x1A00, 0x1801: 0x1A01}


def variables() -> list[ODVariable]:
    found: list[ODVariable] = []
    for item in canopen.import_od(eds_path(), 5).values():
        found += item.subindices.values() if isinstance(item, ODRecord | ODArray) else [item]
    return found


VARIABLES = [
    pytest.param(variable, id=f"{variable.index:04X}sub{variable.subindex} {variable.name}") for variable in variables()
]


def upload(wire, variable: ODVariable) -> str:
    """Data of an upload in hexadecimal, "abort" and its code for a refusal."""
    address = struct.pack("<HB", variable.index, variable.subindex).hex(" ")
    answer = wire.sdo(f"40 {address} 00 00 00 00")
    command, data = int(answer[:2], 16), answer[12:]
    if command == 0x80:
        return f"abort {data}"
    if command & 0x02:
        return data[: 3 * (4 - (command >> 2 & 3))].strip()
    size, text = int.from_bytes(bytes.fromhex(data), "little"), ""
    for toggle in ("60", "70", "60", "70", "60")[: (size + 6) // 7]:
        text += " " + wire.sdo(f"{toggle} 00 00 00 00 00 00 00")[3:]
    return text.strip()[: 3 * size - 1]


def encoded(variable: ODVariable) -> str:
    if variable.data_type == 0x09:
        return str(variable.default).encode("ascii").hex(" ")
    return struct.pack(FORMATS[variable.data_type], variable.default or 0).hex(" ")


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("40 00 10 00", "43 00 10 00 92 01 02 00"),
        ("40 18 10 00", "4f 18 10 00 04 00 00 00"),
        ("40 18 10 01", "43 18 10 01 02 04 00 00"),
        ("40 18 10 02", "43 18 10 02 01 00 00 00"),
        ("40 18 10 03", "43 18 10 03 00 00 01 00"),
        ("40 18 10 04", "43 18 10 04 00 00 00 00"),
        ("40 00 12 01", "43 00 12 01 05 06 00 00"),
        ("40 00 12 02", "43 00 12 02 85 05 00 00"),
    ],
    ids=["servo drive of CiA 402", "identity", "vendor", "product", "revision", "serial", "SDO rx", "SDO tx"],
)
def test_identity(wire, request_, answer):
    assert wire.sdo(f"{request_} 00 00 00 00") == answer


@pytest.mark.parametrize("variable", VARIABLES)
def test_default(wire, variable):
    """Every entry can be read, and holds the EDS's default after power on."""
    data = upload(wire, variable)
    if variable.index == 0x1003 and variable.subindex:
        assert data == "abort 24 00 00 08"
    elif variable.index == 0x2006:
        assert data == "01", "simulated time: that of no other device made after the EDS"
    elif variable.index not in LIVE:
        assert data == encoded(variable)


@pytest.mark.parametrize("variable", VARIABLES)
def test_access(wire, variable):
    """Every writable entry takes the value that it has, in the order that PDOs want; every other one refuses it."""
    address = struct.pack("<HB", variable.index, variable.subindex).hex(" ")
    if variable.data_type == 0x09:
        assert variable.access_type == "const"
        assert wire.sdo(f"2f {address} 31 00 00 00") == f"80 {address} 02 00 01 06"
        return
    if variable.index in (0x1600, 0x1601, 0x1A00, 0x1A01):
        record = next(communication for communication, mapping in ORDER.items() if mapping == variable.index)
        number = struct.pack("<H", record).hex(" ")
        wire.set(f"23 {number} 01 00 00 00 80")
        if variable.subindex:
            wire.set(f"2f {address[:5]} 00 00 00 00 00")
    elif variable.index in ORDER and variable.subindex in (3, 6):
        wire.set(f"23 {address[:5]} 01 00 00 00 80")
    data = encoded(variable).split()
    command = {1: "2f", 2: "2b", 4: "23"}[len(data)]
    answer = wire.sdo(f"{command} {address} {' '.join([*data, *['00'] * (4 - len(data))])}")
    writable = variable.access_type in ("rw", "rww", "rwr", "wo")
    assert answer == (f"60 {address} 00 00 00 00" if writable else f"80 {address} 02 00 01 06")


@pytest.mark.parametrize("variable", [case for case in VARIABLES if case.values[0].min is not None])
def test_limits_of_the_eds_are_the_devices(wire, variable):
    fmt = FORMATS[variable.data_type]
    address = struct.pack("<HB", variable.index, variable.subindex).hex(" ")
    command = {1: "2f", 2: "2b", 4: "23"}[struct.calcsize(fmt)]
    for bound, beyond, abort in ((variable.min, -1, "32 00 09 06"), (variable.max, 1, "31 00 09 06")):
        try:
            data = struct.pack(fmt, bound + beyond) if bound is not None else b""
        except struct.error:
            continue  # the type itself ends here
        if data:
            if variable.index in ORDER:
                wire.set(f"23 {address[:5]} 01 00 00 00 80")
            assert wire.sdo(f"{command} {address} {data.ljust(4, bytes(1)).hex(' ')}") == f"80 {address} {abort}"


class TestFile:
    """CiA 306: the lists of objects, the counts of sub-indices and the PDO counts agree with the sections."""

    @pytest.fixture
    def eds(self) -> configparser.RawConfigParser:
        parser = configparser.RawConfigParser()
        parser.read(eds_path(), encoding="ascii")
        return parser

    def listed(self, eds: configparser.RawConfigParser, section: str) -> list[str]:
        count = eds.getint(section, "SupportedObjects")
        names = [eds.get(section, str(number)) for number in range(1, count + 1)]
        assert len(eds.options(section)) == count + 1
        return [name.removeprefix("0x") for name in names]

    def test_every_object_is_listed_where_it_belongs(self, eds):
        mandatory = self.listed(eds, "MandatoryObjects")
        optional = self.listed(eds, "OptionalObjects")
        maker = self.listed(eds, "ManufacturerObjects")
        assert mandatory == ["1000", "1001", "1018"]
        assert all(int(index, 16) not in range(0x2000, 0x6000) for index in optional)
        assert all(int(index, 16) in range(0x2000, 0x6000) for index in maker)
        sections = {s for s in eds.sections() if len(s) == 4 and all(c in "0123456789ABCDEF" for c in s)}
        assert sections == {*mandatory, *optional, *maker}
        assert len(mandatory + optional + maker) == len(sections)

    def test_sub_numbers(self, eds):
        for section in eds.sections():
            if eds.has_option(section, "SubNumber"):
                subs = [s for s in eds.sections() if s.startswith(f"{section}sub")]
                assert eds.getint(section, "SubNumber") == len(subs), section
                highest = max(int(s.partition("sub")[2], 16) for s in subs)
                if section != "1003" and not section.startswith(("16", "1A")):
                    assert eds.getint(f"{section}sub0", "DefaultValue") == highest, section

    def test_pdo_counts_and_what_is_left_out(self, eds):
        assert eds.getint("DeviceInfo", "NrOfRXPDO") == sum(eds.has_section(f"140{n}") for n in range(8))
        assert eds.getint("DeviceInfo", "NrOfTXPDO") == sum(eds.has_section(f"180{n}") for n in range(8))
        assert [eds.get("DummyUsage", f"Dummy000{n}") for n in range(1, 8)] == ["0"] * 7
        assert eds.get("DeviceInfo", "LSS_Supported") == "0"

    def test_pdo_mappable_is_what_a_mapping_takes(self, wire):
        wire.set("23 00 14 01 00 00 00 80", "2f 00 16 00 00 00 00 00")
        wire.set("23 00 18 01 00 00 00 80", "2f 00 1a 00 00 00 00 00")
        for variable in variables():
            if variable.data_type == 0x09:
                continue
            entry = struct.pack("<BBH", len(variable), variable.subindex, variable.index).hex(" ")
            receives = wire.sdo(f"23 00 16 01 {entry}").startswith("60")
            sends = wire.sdo(f"23 00 1a 01 {entry}").startswith("60")
            assert receives == (variable.pdo_mappable and variable.access_type in ("rw", "rww", "wo")), variable
            assert sends == (variable.pdo_mappable and variable.access_type in ("ro", "rw", "rwr", "const")), variable


def test_the_import_warns_of_nothing(caplog):
    with caplog.at_level("WARNING"):
        dictionary = canopen.import_od(eds_path(), 5)
    assert caplog.records == []
    assert dictionary.device_information.vendor_number == 0x402
    assert len(dictionary) == 3 + 46 + 6
