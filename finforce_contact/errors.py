"""Errors of objects, poses, images and reconstructions."""

from finforce.errors import FinforceError


class ObjectMeshError(FinforceError, ValueError):
    """An object mesh cannot be read, has the wrong size, or has no surface to touch."""


class PoseLostError(FinforceError, RuntimeError):
    """The object was not found again in the image, so that its pose is not known."""


class ReconstructionError(FinforceError, RuntimeError):
    """No object mesh in agreement with the image was found."""
