"""The estimator's rules: what implements each, its purpose, how it is switched off, and which scenes reach it.

A rule is switched off by other values in the place of module attributes, which stand as `module:attribute` where they
are used: `from ... import X` makes a name of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from finforce.compiled import njit
from finforce_ifea.filter import image_update, jump, measurement

_FILTER, _NEVER = "finforce_ifea.filter.", 1e-300
_PATH, _CONTACT = _FILTER + "friction_path:", "finforce_ifea.tracking.contact_state:"
_TRACKER, _SEARCH, _IMAGE, _PROCESS = (f"{_FILTER}{name}:" for name in ("tracker", "search", "image_update", "process"))
_GROSS, _NO_WEIGHT, _FREEDOM = measurement._GROSS, measurement.NO_WEIGHT, measurement.FREEDOM
_ALWAYS = 1e9  # a time [s] or a length [m] over which nothing changes


@dataclass(frozen=True, kw_only=True)
class Rule:
    """One rule of the estimator.

    Attributes:
        name: short.
        implementation: its constants or functions.
        purpose: its purpose.
        off: values that switch it off, by the place where each is used.
        scenes: that reach it; "stress NAME" is a family of the stress tests.
    """

    name: str
    implementation: str
    purpose: str
    off: Mapping[str, Any]
    scenes: tuple[str, ...]


@njit(error_model="numpy")
def _weigh_all_or_nothing(distances):
    """Return weights (m,) of 1, but for gross errors."""
    return np.where((_FREEDOM + 3.0) / (_FREEDOM + distances) > _GROSS, 1.0, _NO_WEIGHT)


@njit(error_model="numpy")
def _weigh_alike(measured, nu, S, depth_variance, asked):
    """Return weights (m,) of 1."""
    return np.ones(len(measured.R))


@njit(error_model="numpy")
def _keep_level(level, distances):
    """Return the noise level of the tare."""
    return 1.0


@njit(error_model="numpy")
def _keep_scatter(scatter, before, z, R):
    """Return the scatter that the noise of the key points tells."""
    return 1.0


def _nothing(*_: Any) -> None:
    """Do nothing."""


def _without(name: str) -> tuple[Any, ...]:
    """Return the jumps of one image, one of them impossible."""
    own = getattr(jump, name)
    return tuple(each._replace(probability=_NEVER) if each is own else each for each in jump.JUMPS)


_NOISE = image_update.DEPTH_NOISE


def _with_noise(**changes: float) -> dict[str, Any]:
    """Return another process noise of the depth, where it is used."""
    return {place + "DEPTH_NOISE": _NOISE._replace(**changes) for place in (_SEARCH, _IMAGE)}


def _rule(name: str, implementation: str, purpose: str, off: Mapping[str, Any], *scenes: str) -> Rule:
    return Rule(name=name, implementation=implementation, purpose=purpose, off=off, scenes=scenes)


RULES = (
    _rule("Student's t", "`FREEDOM`", "reduces the weight of key points with moderate errors",
          {f"{_FILTER}{name}:weigh": _weigh_all_or_nothing for name in ("filter", "jump")},
          "tailed", "gross", "press"),
    _rule("gross errors", "`_GROSS`", "removes key points with large errors",
          {_FILTER + "measurement:_GROSS": 0.0}, "gross", "cluster", "occluded"),
    _rule("initial weights", "`_weigh_innovations`", "weights before the first update, with the motion removed",
          {_FILTER + "jump:_weigh_innovations": _weigh_alike}, "gross", "cluster", "fast"),
    _rule("linearisation error", "`_NONLINEAR`", "larger tolerance of the initial weights after a motion",
          {_FILTER + "jump:_NONLINEAR": 0.0}, "fast", "gross", "stress gross"),
    _rule("noise level", "`_LEVEL_IMAGES`", "noise above that of the tare",
          {_IMAGE + "_follow_level": _keep_level}, "noisy", "gross"),
    _rule("scatter of the depth", "`_follow_scatter`", "depths noisier than their key points tell",
          {_IMAGE + "_follow_scatter": _keep_scatter}, "swaying", "noisy", "paused"),
    _rule("correlated noise", "`measure_correlation`", "noise that neighbouring key points share",
          {"finforce_ifea.tare:measure_correlation": lambda scatter, keypoints: np.eye(len(keypoints))}, "alike"),
    _rule("depth smoothing", "`DEPTH_NOISE`", "averages the depth over images",
          _with_noise(drift=1.0), "press", "noisy", "rubbed"),
    _rule("two motion models", "`rest_time`", "a model of rest beside that of motion",
          _with_noise(rest_time=1e-3) | {_SEARCH + "_FREE_TIME": 1e-3},
          "rested", "press", "noisy"),
    _rule("depth jumps", "`jump_probability`", "missed images, fast jaws",
          _with_noise(jump_probability=0.0), "fast", "press"),
    _rule("short rest of open jaws", "`_FREE_TIME`", "detects the onset of contact early",
          {_SEARCH + "_FREE_TIME": _NOISE.rest_time}, "tapping", "fast", "press"),
    _rule("bumped camera", "`BUMPED`", "a bump that shows in one image",
          {_FILTER + "jump:JUMPS": _without("BUMPED")}, "bumped"),
    _rule("nudged camera", "`NUDGED`", "a bump that shows only over several images",
          {_SEARCH + "NUDGED": jump.NUDGED._replace(probability=_NEVER)}, "nudged", "drifting"),
    _rule("misplaced contact", "`MISPLACED`", "a wrong height that shows in one image",
          {_FILTER + "jump:JUMPS": _without("MISPLACED")}, "slammed", "misplaced"),
    _rule("contact offset", "`OFFSET`", "a wrong height that shows only over several images",
          {_SEARCH + "OFFSET": jump.OFFSET._replace(probability=_NEVER)}, "offset", "misplaced"),
    _rule("model error, constant", "`MODEL_FLOOR`", "standard deviation", {_PROCESS + "MODEL_FLOOR": 0.0},
          "other finger", "press"),
    _rule("edges that hardly touch", "`_INCLINED`", "standard deviation of the traction ratio",
          {_IMAGE + "_INCLINED": 0.0}, "wide box", "low box", "box"),
    _rule("presence", "`_LEAST_PRESENCE`", "given contacts: ignores key points that appear only now and then",
          {"finforce_ifea.tracking.given_contact:_LEAST_PRESENCE": 0.0}, "occluded"),
    _rule("model error, of a shape", "`MODEL_SHAPE`", "standard deviation", {_PROCESS + "MODEL_SHAPE": 0.0},
          "other finger", "press"),
    _rule("model error, of all shapes", "`MODEL_RELATIVE`", "standard deviation",
          {_PROCESS + "MODEL_RELATIVE": 1e-6}, "other finger", "press"),
    _rule("detector bias", "`DETECTOR_LENGTH`", "a detector error that lasts while the view is unchanged",
          {_PROCESS + "DETECTOR_LENGTH": _ALWAYS}, "sight"),
    _rule("traction beyond friction", "`TRACTION_FLOOR`, `TRACTION_SHARE`",
          "traction that the friction path does not explain",
          {_IMAGE + "TRACTION_FLOOR": 1e-3, _IMAGE + "TRACTION_SHARE": 0.0}, "rubbed", "probed", "paused", "fixed"),
    _rule("correlation length of that traction", "`TRACTION_LENGTH`", "how far the object moves before it changes",
          {_PROCESS + "TRACTION_LENGTH": _ALWAYS},
          "rubbed", "probed", "paused"),
    _rule("apparent traction", "`APPARENT_TRACTION`", "model errors that look like traction",
          {_IMAGE + "APPARENT_TRACTION": 1e-6}, "other finger", "rubbed", "fixed"),
    _rule("apparent traction of a detector", "`APPARENT_DETECTOR`", "lasting detector errors that look like traction",
          {_IMAGE + "APPARENT_DETECTOR": 0.0}, "sight"),
    _rule("errors in common", "`COMMON`", "standard deviation of what all key points err by alike",
          {_IMAGE + "COMMON": 0.0}, "sight"),
    _rule("correlation time of apparent traction", "`APPARENT_TIME`", "how long it lasts",
          {_PROCESS + "APPARENT_TIME": _ALWAYS},
          "other finger", "rubbed", "fixed"),
    _rule("camera drift", "`CAMERA_SHIFT`, `CAMERA_TURN_STDDEV`", "a camera that drifts",
          {_IMAGE + "_STILL": np.zeros(4)}, "drifting", "nudged", "press"),
    _rule("correlation time of the drift", "`CAMERA_TIME`", "how long it lasts",
          {_IMAGE + "CAMERA_TIME": _ALWAYS}, "drifting", "press"),
    _rule("rotation and scale of an uncertain pose", "`PLACE_TURN`, `PLACE_STRETCH`", "errors that key points share",
          {_IMAGE + "PLACE_TURN": 0.0, _IMAGE + "PLACE_STRETCH": 0.0}, "unplaced"),
    _rule("correlation time of that pose error", "`PLACE_TIME`", "how long it lasts",
          {_IMAGE + "PLACE_TIME": 20.0}, "unplaced"),
    _rule("friction path", "`TractionHypotheses`", "the share of its friction that an object uses",
          {_PATH + "TractionHypotheses.follow": _nothing}, "rubbed", "probed", "paused"),
    _rule("two edges", "`_GAP`", "edges of a flat object that stick and slide in turn",
          {_FILTER + "slip_path:_GAP": 1.0}, "rubbed box", "wide box", "rubbed"),
    _rule("path correction", "`_take_back`", "motions that ended earlier than they seemed to",
          {_PATH + "TractionHypotheses._take_back": _nothing}, "paused", "rubbed", "probed"),
    _rule("reversal threshold", "`_REVERSAL`, `_REVERSAL_AT_REST`", "keeps noise from counting as a reversal",
          {_PATH + "_REVERSAL": 0.0, _PATH + "_REVERSAL_AT_REST": 0.0}, "rubbed", "probed", "paused"),
    _rule("height threshold", "`_HEIGHT_PLAY`", "keeps noise from counting as motion along the finger",
          {_PATH + "_HEIGHT_PLAY": 0.0}, "rubbed", "probed", "paused"),
    _rule("sliding contact", "`_SLIDING`", "smaller deviation while the whole contact slides",
          {_PATH + "_SLIDING": 1.0},
          "rubbed", "probed", "paused"),
    _rule("minimum weight", "`_LEAST_WEIGHT`", "lets hypotheses recover", {_FILTER + "filter:_LEAST_WEIGHT": -1e6},
          "handed", "lifted", "rubbed"),
    _rule("held by the jaws", "`_HELD`", "objects that only the jaws hold", {_PATH + "_HELD": 0.0},
          "held", "lifted", "handed"),
    _rule("object carried along", "`CarriedObject`", "objects that the bending jaws move show that only they hold them",
          {_FILTER + "carried_object:_MOVED": 1e6}, "moved", "held"),
    _rule("friction limit", "`bound_held`", "objects that friction cannot hold",
          {_PATH + "TractionHypotheses.bound_held": lambda self, weights: weights}, "fixed", "held"),
    _rule("step halving at corners", "`has_corners`", "objects that rock",
          {"finforce_ifea.contact_mechanics.indenter:OutlineIndenter.has_corners": False},
          "box", "wide box", "low box"),
    _rule("unobserved force", "`_find_unobserved_stddev`", "deviation due to contact where no key point shows it",
          {_TRACKER + "ContactTracker._find_unobserved_stddev": lambda *_: 0.0}, "low box", "wide box", "box"),
    _rule("unobserved force along the face", "`_ELSEWHERE`", "the same, away from the clamp",
          {_FILTER + "unobserved_force:_ELSEWHERE": _ALWAYS}, "wide box", "box", "low box", "stress objects"),
    _rule("full model", "`_BEYOND_STORED`", "shapes beyond the stored ones",
          {_TRACKER + "ContactTracker._change_fidelity": _nothing}, "wide box", "low box"),
    _rule("reset after a release", "`_IMAGES_RELEASED`", "another object", {_TRACKER + "_IMAGES_RELEASED": 10**9},
          "next"),
    _rule("lateral load", "`LateralLoad`", "force across the finger, and its torsion",
          {"finforce_ifea.filter.lateral_load:LateralLoad.update": _nothing}, "across", "carried"),
    _rule("weight across the finger", "`_WEIGHT`", "a weight that pulls across the fingers",
          {"finforce_ifea.filter.lateral_load:_LIFTED": -np.inf}, "carried"),
    _rule("posture of the gripper", "`PostureTrack`", "what only the jaws hold, and its weight, by turns and lifts",
          {"finforce_ifea.posture:PostureTrack.update": _nothing}, "turned"),
    _rule("lateral threshold", "`_CLEAR`", "keeps noise from counting as a lateral force",
          {"finforce_ifea.filter.lateral_load:_CLEAR": 1e-3}, "across", "box"),
    _rule("following a slide", "`_lead`", "objects that slide, as their pose shows",
          {_TRACKER + "ContactTracker._lead": _nothing}, "sliding"),
    _rule("direction error", "`_MISDIRECTED`", "standard deviation", {_FILTER + "readout:_MISDIRECTED": 0.0},
          "other finger", "rubbed", "fixed"),
    _rule("refined tare", "`_LONGEST_TARE`", "averages the offsets until the first load",
          {"finforce_ifea.tare:_LONGEST_TARE": 5}, "briefly tared"),
    _rule("rejection: wrong height", "`_MISTAKEN`", "no force", {_CONTACT + "_MISTAKEN": 2.0}, "misplaced", "untold"),
    _rule("rejection: uncertain", "`largest_stddev`", "no force",
          {_CONTACT + "_VAGUE_SHARE": np.inf}, "low box", "wide box"),
    _rule("rejection: tensile", "`_LEAST_PULL`", "no force",
          {_CONTACT + "_LEAST_PULL": np.inf, _CONTACT + "_MOST_PULL": np.inf}, "bumped", "misplaced"),
    _rule("rejection: disagreement", "`is_believed`", "no force from key points that disagree",
          {_SEARCH + "is_believed": lambda mean, weight, V: True}, "cluster", "bumped", "unplaced"),
)  # fmt: skip
