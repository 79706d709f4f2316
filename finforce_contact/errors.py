"""Errors of objects, poses, images and reconstructions, and the check that numbers are finite."""

from math import isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.camera import ImageError
from finforce.errors import FinforceError, PoseError
from finforce_ifea.errors import ContactError

__all__ = ["ImageError", "ObjectMeshError", "PoseError", "PoseLostError", "ReconstructionError"]


class ObjectMeshError(FinforceError, ValueError):
    """An object mesh cannot be read, has the wrong size, or has no surface to touch."""


class PoseLostError(FinforceError, RuntimeError):
    """The object was not found again in the image, so that its pose is not known."""


class ReconstructionError(FinforceError, RuntimeError):
    """No object mesh in agreement with the image was found."""


def to_floats(values: ArrayLike, what: str, error: type[FinforceError]) -> NDArray:
    """Return values as an array of floats; raises `error` for what holds no numbers or has ragged rows."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise error(f"{what}: got {type(values).__name__} {str(values)[:60]!r}, expected an array of numbers") from None


def check_stamp(stamp: float, what: str, error: type[FinforceError]) -> None:
    """Refuse a stamp [s] that is not finite by raising `error`; one such would stop a clock for ever."""
    if not isfinite(stamp):
        raise error(f"{what}: got stamp {stamp}, expected the capture time in seconds")


def check_wrench(wrench: tuple[NDArray, NDArray]) -> tuple[NDArray, NDArray]:
    """Return force (3,) [N] and torque (3,) [N m] as floats; raises ContactError for what is no wrench."""
    try:
        force, torque = (to_floats(part, "wrench", ContactError) for part in wrench)
    except (TypeError, ValueError) as error:
        if isinstance(error, ContactError):
            raise
        raise ContactError(f"wrench: got {wrench!r}, expected a force (3,) [N] and a torque (3,) [N m]") from None
    if force.shape != (3,) or torque.shape != (3,) or not np.isfinite([force, torque]).all():
        raise ContactError(f"wrench of force {force} and torque {torque}, expected three finite numbers each")
    return force, torque
