"""What tests of the gripper's driver are given: both firmware variants, a driver on each, an adapter to unplug."""

import pytest
from emulator_fakes import VARIANTS, FakeAdapter, Rig


@pytest.fixture(params=VARIANTS)
def variant(request):
    """Each variant of the gripper's firmware."""
    return request.param


@pytest.fixture
def rig(variant):
    """A driver and an emulated gripper in stepped time."""
    return Rig(variant)


@pytest.fixture
def adapter(tmp_path):
    """An adapter behind a pseudo-terminal, unplugged at the end."""
    fake = FakeAdapter(tmp_path)
    yield fake
    fake.unplug()
