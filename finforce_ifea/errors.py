"""Errors of jaws, key points and contacts; anything else that is raised is a defect."""

from finforce.errors import FinforceError, MissingDependencyError  # noqa: F401 - the base of those here


class JawFileError(FinforceError, ValueError):
    """A jaw file says something that cannot be a jaw."""


class MeshError(FinforceError, ValueError):
    """A volume mesh cannot be computed with, or a point does not lie on it."""


class ContactError(FinforceError, ValueError):
    """A contact does not lie on the jaw, or its weights are no weights."""


class UnderLoadError(FinforceError, RuntimeError):
    """A tare was asked for while something presses on the jaw."""


class CalibrationError(FinforceError, ValueError):
    """A calibration file or a calibration run makes no sense."""


class NotEnoughDataError(FinforceError, RuntimeError):
    """Too few observations have arrived for what was asked."""


class UnobservableError(NotEnoughDataError):
    """The key points that are seen do not tell what was asked."""
