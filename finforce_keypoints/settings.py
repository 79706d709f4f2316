"""What can be set on a key point detector, and the work that it leaves out by the names of its rules."""

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from finforce.skipping import IDLE, STILL
from finforce_keypoints.errors import DetectorSettingsError


@dataclass(frozen=True, kw_only=True)
class DetectorSettings:
    """Settings of `KeypointDetector`; each field's metadata says unit, bounds and meaning."""

    likelihood: float = setting(0.6, "a key point less likely than this is not there", "1", 0.0, 1.0)
    plane_depth: bool = setting(
        False, "believe key points without depth, too, on the plane that the jaw's side is known to be", ""
    )
    window: float = setting(3e-3, "around a key point, depth is taken from the finger's side this far", "m", 5e-4, 0.02)
    edge: float = setting(0.4e-3, "and no nearer than this to an edge, where depths are mixed", "m", 0.0, 5e-3)
    wide_gate: float = setting(5e-3, "depth farther off the known side plane is not the finger's", "m", 1e-3, 0.05)
    gate: float = setting(2e-3, "the same, once the plane is found in the image", "m", 5e-4, 0.02)
    least_depths: int = setting(6, "samples of the finger's side with depth that a key point needs", "1", 1, 1000)
    least_share: float = setting(0.4, "share of a key point's depths that must be the finger's", "1", 0.0, 1.0)
    quantum: float = setting(1e-3, "step of the depth image", "m", 0.0, 0.01)
    depth_noise: float = setting(0.06e-3, "error of the depth that the samples of one point share", "m", 0.0, 0.01)
    scale_stddev: float = setting(0.015, "relative error that all depths of a camera share", "1", 0.0, 0.1)
    scale_drift: float = setting(1e-3, "random walk of this error", "1/s^0.5", 0.0, 0.1)
    offset_stddev: float = setting(0.2e-3, "of the jaw's side from where it should be, at its base", "m", 0.0, 0.01)
    tilt_stddev: float = setting(0.02, "of the slopes of the jaw's side, bent or ill calibrated", "1", 0.0, 0.5)
    bow_stddev: float = setting(0.2, "of the side's curvature, bent sideways: y = bow z^2", "1/m", 0.0, 10.0)
    relief_stddev: float = setting(0.06e-3, "of single key points off the plane of the jaw's side", "m", 0.0, 0.01)
    misfit: float = setting(5.0, "a key point whose depth is farther off than this is not there", "sigma", 1.0, 100.0)
    workspace_closing: float = setting(0.025, "how far a key point may leave its place along x", "m", 1e-3, 0.5)
    workspace_width: float = setting(4e-3, "the same along y", "m", 1e-4, 0.5)
    workspace_length: float = setting(0.012, "the same along z", "m", 1e-3, 0.5)
    readout: float = setting(
        0.0,
        "a rolling shutter's, from the first row's exposure to the last one's, which the stamp tells",
        "s",
        0.0,
        0.1,
    )
    opening_min: float = setting(0.010, "least distance of a jaw's origin from the middle of the grasp", "m", 0.0, 0.5)
    opening_max: float = setting(0.080, "largest distance of a jaw's origin from there", "m", 1e-3, 0.5)
    acceleration: float = setting(
        2e-3, "random walk of the closing speed; what is more is noticed and followed", "m/s^1.5", 1e-6, 10.0
    )
    origin_gate: float = setting(3.0, "an origin farther off means that the speed changed", "sigma", 1.0, 100.0)
    largest_speed: float = setting(0.3, "a jaw never moves faster", "m/s", 1e-3, 10.0)
    reference_tolerance: float = setting(
        5e-3, "a reference point farther off its line of motion is another thing", "m", 1e-4, 0.1
    )
    largest_beside: float = setting(
        0.015, "with the middle between two jaws farther beside the gripper's, none is told of", "m", 1e-3, 1.0
    )
    rigid_stddev: float = setting(
        0.3e-3, "bending of the jaw 10 mm above its base, more with the square of the height", "m", 1e-5, 0.01
    )
    origin_stddev: float = setting(0.6e-3, "a jaw whose place is less well known is not found", "m", 1e-5, 0.02)
    rest_tolerance: float = setting(
        1.1e-3, "key points at rest that lie farther from the jaw file, root mean square, are warned of", "m", 1e-4, 0.1
    )
    lost_images: int = setting(
        5, "after so many images without it, or without a valid key point, a jaw is lost", "images", 1, 1000
    )

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            DetectorSettingsError: a setting is outside its bounds, or a lower bound is above its upper one.
        """
        check_bounds(self, DetectorSettingsError)
        if self.wide_gate < self.gate:
            raise DetectorSettingsError(
                f"wide_gate: got {self.wide_gate:g} m, expected no less than gate, {self.gate:g} m"
            )
        if self.opening_max <= self.opening_min:
            raise DetectorSettingsError(
                f"opening_max: got {self.opening_max:g} m, expected more than opening_min, {self.opening_min:g} m"
            )


UNSEEN = "jaw not in view"
ANNOTATED = "annotated image not wanted"
RULES = (STILL, IDLE, UNSEEN, ANNOTATED)

LOOK_EVERY = 4.0  # [s] after which an image is looked at in full though nothing has moved
SEARCHED = 30  # images in each of which a lost jaw is looked for
SEARCH_EVERY = 5  # images, in one of which it is looked for from then on
