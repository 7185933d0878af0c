from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.can_vm.errors import MachineUnavailableError
from deploy.can_vm.modules import dependencies, load_order, module_name

NEEDS: dict[str, tuple[str, ...] | None] = {
    "vcan": ("can_dev",),
    "kvaser_pci": ("sja1000",),
    "sja1000": ("can_dev",),
    "can_dev": (),
    "virtio_pci": ("virtio",),
    "virtio": None,
}


def test_names_are_the_kernels() -> None:
    assert module_name("./lib/modules/6.1/kernel/net/can/can-raw.ko") == "can_raw"
    assert module_name("can-raw.ko.xz") == "can_raw"
    assert module_name("kernel/drivers/net/can/sja1000/kvaser_pci.ko") == "kvaser_pci"


def test_dependencies_are_read_from_the_modinfo_section() -> None:
    assert dependencies(b"\x7fELF\0license=GPL v2\0depends=can-dev,sja1000\0retpoline=Y\0") == ("can_dev", "sja1000")
    assert dependencies(b"\x7fELF\0depends=\0name=virtio\0") == ()
    assert dependencies(b"\x7fELF") == ()


def test_each_module_comes_after_what_it_needs() -> None:
    assert load_order(["kvaser_pci", "vcan"], NEEDS.__getitem__) == ("can_dev", "sja1000", "kvaser_pci", "vcan")


def test_what_the_kernel_contains_is_not_loaded() -> None:
    assert load_order(["virtio", "virtio_pci"], NEEDS.__getitem__) == ("virtio_pci",)


def test_a_circle_is_named() -> None:
    with pytest.raises(MachineUnavailableError, match="a → b → a"):
        load_order(["a"], {"a": ("b",), "b": ("a",)}.__getitem__)


@given(st.dictionaries(st.integers(0, 15), st.sets(st.integers(0, 15)), max_size=16))
def test_the_order_holds_for_any_graph_without_circles(drawn: dict[int, set[int]]) -> None:
    needs = {str(node): tuple(str(other) for other in others if other < node) for node, others in drawn.items()}
    order = load_order(needs, lambda name: needs.get(name, ()))
    assert len(order) == len(set(order))
    assert set(needs) <= set(order)
    assert all(order.index(other) < order.index(name) for name in order for other in needs.get(name, ()))
