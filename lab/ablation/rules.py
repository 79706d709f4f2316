"""The estimator's rules: what each stands on, what it is for, how it is switched off, and which scenes reach it.

A rule is switched off by other values in the place of module attributes, which stand as `module:attribute` where they
are used: `from ... import X` makes a name of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from finforce_ifea.filter import jump, measurement, search

_FILTER, _NEVER = "finforce_ifea.filter.", 1e-300
_PATH, _CONTACT = _FILTER + "friction_path:", "finforce_ifea.tracking.contact_state:"
_TRACKER, _SEARCH, _PROCESS = (f"{_FILTER}{name}:" for name in ("tracker", "search", "process"))
_GROSS, _NO_WEIGHT, _FREEDOM = measurement._GROSS, measurement.NO_WEIGHT, measurement.FREEDOM
_ALWAYS = 1e9  # a time [s] or a length [m] over which nothing changes


@dataclass(frozen=True, kw_only=True)
class Rule:
    """One rule of the estimator.

    Attributes:
        name: short.
        stands_on: constants or functions.
        purpose: its purpose.
        off: values that switch it off, by the place where each is used.
        scenes: that reach it.
    """

    name: str
    stands_on: str
    purpose: str
    off: Mapping[str, Any]
    scenes: tuple[str, ...]


@njit(error_model="numpy")
def _weigh_all_or_nothing(distances):
    """Return weights (m,) of 1, but for gross errors."""
    return np.where((_FREEDOM + 3.0) / (_FREEDOM + distances) > _GROSS, 1.0, _NO_WEIGHT)


@njit(error_model="numpy")
def _weigh_alike(measured, nu, S, depth_variance):
    """Return weights (m,) of 1."""
    return np.ones(len(measured.R))


def _nothing(*_: Any) -> None:
    """Do nothing."""


def _without(name: str) -> tuple[Any, ...]:
    """Return the jumps of one image, one of them impossible."""
    own = getattr(jump, name)
    return tuple(each._replace(probability=_NEVER) if each is own else each for each in search._JUMPS)


def _rule(name: str, stands_on: str, purpose: str, off: Mapping[str, Any], *scenes: str) -> Rule:
    return Rule(name=name, stands_on=stands_on, purpose=purpose, off=off, scenes=scenes)


_NOISE = search._DEPTH_NOISE
RULES = (
    _rule("Student's t", "`FREEDOM`", "weights of key points that are a little off",
          {f"{_FILTER}{name}:weigh": _weigh_all_or_nothing for name in ("filter", "jump")},
          "tailed", "gross", "press"),
    _rule("gross errors", "`_GROSS`", "no weight for those that are far off",
          {_FILTER + "measurement:_GROSS": 0.0}, "gross", "cluster", "occluded"),
    _rule("first weights", "`_weigh_innovations`", "weights before the first update, the motion taken out",
          {_FILTER + "jump:_weigh_innovations": _weigh_alike}, "gross", "cluster", "fast"),
    _rule("error of the linearisation", "`_NONLINEAR`", "more tolerance of first weights after a motion",
          {_FILTER + "jump:_NONLINEAR": 0.0}, "fast", "gross"),
    _rule("noise level", "`_LEVEL_IMAGES`", "noise beyond that of the tare",
          {_SEARCH + "_follow_level": lambda level, distances: 1.0}, "noisy", "gross"),
    _rule("smoothing of the depth", "`_DEPTH_NOISE`", "noise of the depth, averaged over images",
          {_SEARCH + "_DEPTH_NOISE": _NOISE._replace(drift=1.0)}, "press", "noisy", "rubbed"),
    _rule("two models of the depth", "`rest_time`", "rest beside motion",
          {_SEARCH + "_DEPTH_NOISE": _NOISE._replace(rest_time=1e-3), _SEARCH + "_FREE_TIME": 1e-3},
          "rested", "press", "noisy"),
    _rule("jumps of the depth", "`jump_probability`", "images that were missed, fast jaws",
          {_SEARCH + "_DEPTH_NOISE": _NOISE._replace(jump_probability=0.0)}, "fast", "press"),
    _rule("open jaws are about to close", "`_FREE_TIME`", "onset of a touch",
          {_SEARCH + "_FREE_TIME": _NOISE.rest_time}, "tapping", "fast", "press"),
    _rule("bumped camera", "`BUMPED`", "a bump that one image shows",
          {_SEARCH + "_JUMPS": _without("BUMPED")}, "bumped"),
    _rule("nudged camera", "`NUDGED`", "a bump that several images show",
          {_SEARCH + "NUDGED": jump.NUDGED._replace(probability=_NEVER)}, "nudged", "drifting"),
    _rule("misplaced contact", "`MISPLACED`", "a wrong height that one image shows",
          {_SEARCH + "_JUMPS": _without("MISPLACED")}, "slammed", "misplaced"),
    _rule("contact off", "`OFFSET`", "a wrong height that several images show",
          {_SEARCH + "OFFSET": jump.OFFSET._replace(probability=_NEVER)}, "offset", "misplaced"),
    _rule("error of the mechanics, constant", "`MODEL_FLOOR`", "deviation", {_PROCESS + "MODEL_FLOOR": 0.0},
          "other finger", "press"),
    _rule("error of the mechanics, of a shape", "`MODEL_SHAPE`", "deviation", {_PROCESS + "MODEL_SHAPE": 0.0},
          "other finger", "press"),
    _rule("error of the mechanics, of all shapes", "`MODEL_RELATIVE`", "deviation",
          {_PROCESS + "MODEL_RELATIVE": 1e-6}, "other finger", "press"),
    _rule("sight", "`SIGHT_LENGTH`", "error of a detector that lasts while it sees the same",
          {_PROCESS + "SIGHT_LENGTH": _ALWAYS}, "sight"),
    _rule("traction beyond friction", "`TRACTION_FLOOR`, `TRACTION_SHARE`", "what the path does not explain",
          {_SEARCH + "TRACTION_FLOOR": 1e-3, _SEARCH + "TRACTION_SHARE": 0.0}, "rubbed", "probed", "paused", "fixed"),
    _rule("it changes with motion", "`TRACTION_LENGTH`", "its memory", {_PROCESS + "TRACTION_LENGTH": _ALWAYS},
          "rubbed", "probed", "paused"),
    _rule("apparent traction", "`APPARENT_TRACTION`", "errors of the mechanics that look like traction",
          {_PROCESS + "APPARENT_TRACTION": 1e-6}, "other finger", "rubbed", "fixed"),
    _rule("it changes with time", "`APPARENT_TIME`", "its memory", {_PROCESS + "APPARENT_TIME": _ALWAYS},
          "other finger", "rubbed", "fixed"),
    _rule("moving camera", "`CAMERA_SHIFT`, `CAMERA_TURN_STDDEV`", "a camera that drifts",
          {_SEARCH + "_STILL": np.zeros(4)}, "drifting", "nudged", "press"),
    _rule("it moves back", "`CAMERA_TIME`", "its memory", {_SEARCH + "CAMERA_TIME": _ALWAYS}, "drifting", "press"),
    _rule("turn and stretch of an uncertain place", "`PLACE_TURN`, `PLACE_STRETCH`", "points that are off together",
          {_SEARCH + "PLACE_TURN": 0.0, _SEARCH + "PLACE_STRETCH": 0.0}, "unplaced"),
    _rule("it is off anew", "`PLACE_TIME`", "its memory", {_SEARCH + "PLACE_TIME": 20.0}, "unplaced"),
    _rule("path of friction", "`TractionHypotheses`", "how much of its friction an object uses",
          {_PATH + "TractionHypotheses.follow": _nothing}, "rubbed", "probed", "paused"),
    _rule("taking back", "`_take_back`", "stops short of where the motion seemed to end",
          {_PATH + "TractionHypotheses._take_back": _nothing}, "paused", "rubbed", "probed"),
    _rule("noise is no way back", "`_REVERSAL`, `_REVERSAL_AT_REST`", "path of an object that rests",
          {_PATH + "_REVERSAL": 0.0, _PATH + "_REVERSAL_AT_REST": 0.0}, "rubbed", "probed", "paused"),
    _rule("noise is no motion along the finger", "`_HEIGHT_PLAY`", "path of an object that rests",
          {_PATH + "_HEIGHT_PLAY": 0.0}, "rubbed", "probed", "paused"),
    _rule("sliding contacts are surer", "`_SLIDING`", "deviation of the path", {_PATH + "_SLIDING": 1.0},
          "rubbed", "probed", "paused"),
    _rule("least weight", "`_LEAST_WEIGHT`", "hypotheses that come back", {_FILTER + "filter:_LEAST_WEIGHT": -1e6},
          "handed", "lifted", "rubbed"),
    _rule("held by the jaws", "`_HELD`", "objects that nothing else holds", {_PATH + "_HELD": 0.0},
          "held", "lifted", "handed"),
    _rule("friction must bear it", "`bound_held`", "objects that friction cannot hold",
          {_PATH + "TractionHypotheses.bound_held": lambda self, weights: weights}, "fixed", "held"),
    _rule("halving at corners", "`has_corners`", "objects that rock",
          {"finforce_ifea.contact_mechanics.indenter:OutlineIndenter.has_corners": False},
          "box", "wide box", "low box"),
    _rule("hidden force", "`_find_hidden`", "deviation of what may press where nothing shows it",
          {_TRACKER + "ContactTracker._find_hidden": lambda *_: 0.0}, "low box", "wide box", "box"),
    _rule("hidden force along the face", "`_ELSEWHERE`", "the same, away from the clamp",
          {_FILTER + "hidden:_ELSEWHERE": _ALWAYS}, "wide box", "box", "low box"),
    _rule("full mechanics", "`_BEYOND_STORED`", "shapes that are not stored",
          {_TRACKER + "ContactTracker._change_fidelity": _nothing}, "wide box", "low box"),
    _rule("forgetting after a release", "`_IMAGES_RELEASED`", "another object", {_TRACKER + "_IMAGES_RELEASED": 10**9},
          "next"),
    _rule("lateral load", "`LateralLoad`", "force across the finger, and its twist",
          {"finforce_ifea.filter.lateral_load:LateralLoad.update": _nothing}, "across", "carried"),
    _rule("weight across", "`_WEIGHT`", "a weight that pulls across the fingers",
          {_TRACKER + "expect_weight": lambda gravity: None}, "carried"),
    _rule("small ratios are none", "`_CLEAR`", "chance across the finger",
          {"finforce_ifea.filter.lateral_load:_CLEAR": 1e-3}, "across", "box"),
    _rule("leading a slide", "`_lead`", "objects that slide, as their pose shows",
          {_TRACKER + "ContactTracker._lead": _nothing}, "sliding"),
    _rule("length of a slide", "`_SLIDE`", "its deviation", {_SEARCH + "_SLIDE": 0.0}, "sliding"),
    _rule("direction of the force", "`_MISDIRECTED`", "deviation", {_FILTER + "readout:_MISDIRECTED": 0.0},
          "other finger", "rubbed", "fixed"),
    _rule("presence", "`_LEAST_PRESENCE`", "key points that are seen now and then",
          {"finforce_ifea.estimator:_LEAST_PRESENCE": 0.0}, "occluded"),
    _rule("forces that were not told", "`_UNTOLD`", "deviation of what they leave",
          {"finforce_ifea.estimator:_UNTOLD": 0.0}, "untold"),
    _rule("refined tare", "`_LONGEST_TARE`", "offsets, until the first load",
          {"finforce_ifea.tare:_LONGEST_TARE": 5}, "briefly tared"),
    _rule("rejection: misfit", "`_LARGEST_MISFIT`", "no force", {_CONTACT + "_LARGEST_MISFIT": np.inf},
          "misplaced", "untold", "cluster"),
    _rule("rejection: wrong height", "`_MISTAKEN`", "no force", {_CONTACT + "_MISTAKEN": 2.0}, "misplaced", "untold"),
    _rule("rejection: unsettled", "`_AMBIGUOUS`", "no force", {_CONTACT + "_AMBIGUOUS": np.inf},
          "box", "wide box", "fast"),
    _rule("rejection: vague", "`_VAGUE_FORCE`", "no force", {_CONTACT + "_VAGUE_FORCE": np.inf}, "low box", "wide box"),
    _rule("rejection: pulling", "`_LEAST_PULL`", "no force",
          {_CONTACT + "_LEAST_PULL": np.inf, _CONTACT + "_MOST_PULL": np.inf}, "bumped", "misplaced"),
    _rule("disbelief", "`_is_believed`", "images whose key points disagree",
          {_SEARCH + "_is_believed": lambda posterior, V: True}, "cluster", "bumped", "unplaced"),
)  # fmt: skip
