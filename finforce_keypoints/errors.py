"""The errors that finding key points raises on purpose; one class per cause."""

from finforce.camera import ImageError
from finforce.errors import FinforceError


class KeypointError(FinforceError):
    """The base of every error that finding key points raises on purpose."""


class ModelError(KeypointError, ValueError):
    """A network file, or the metadata beside it, cannot be used; a start-up error."""


class NamingError(KeypointError, ValueError):
    """The body parts of a network are not the key points of the jaws; a start-up error."""


class DetectionError(KeypointError, ValueError):
    """An image cannot be searched for key points with this method."""


class DetectorSettingsError(KeypointError, ValueError):
    """A setting of the detector is out of its bounds."""


class GeometryError(KeypointError, ValueError):
    """A camera or a jaw is said to be where it cannot be; a start-up error."""


class BlackImageError(KeypointError, ImageError):
    """A picture shows nothing."""


class EmptyDepthError(KeypointError, ImageError):
    """A depth image has no depth anywhere."""


class FrozenImageError(KeypointError, ImageError):
    """A camera gives the same picture again and again."""


class ImageOrderError(KeypointError, ImageError):
    """An image is not younger than the one before."""


class SyncError(KeypointError, ImageError):
    """No depth image belongs to a colour image."""
