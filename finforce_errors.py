"""The base of the errors that finforce raises on purpose, and of missing libraries; knows no package."""


class FinforceError(Exception):
    """The base of every error that finforce raises on purpose."""


class MissingDependencyError(FinforceError, ImportError):
    """An optional library is needed and not installed."""
