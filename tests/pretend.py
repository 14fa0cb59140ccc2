"""Moved to tests/helpers/fake_device.py."""

from tests.helpers.fake_device import NAME as NAME, MOVES as MOVES, HALVED as HALVED, Pretend as Pretend, run as run, empty as empty, empty_strided as empty_strided, copied as copied, in_halves as in_halves, Module as Module, PretendAccelerator as PretendAccelerator, missing as missing, register as register, device as device, without_doubles as without_doubles  # noqa: E501, F401, I001, PLC0414
