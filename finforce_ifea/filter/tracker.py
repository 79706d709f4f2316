"""Tracks the contact with the pressing object by the filter; see `finforce_ifea.filter`."""

from __future__ import annotations

from numpy.typing import NDArray

from finforce_ifea.filter.search import FilterSearch
from finforce_ifea.observation import Observation
from finforce_ifea.tare import Tare
from finforce_ifea.tracking.contact_search import TOUCH_DEPTH
from finforce_ifea.tracking.contact_state import ContactState
from finforce_ifea.tracking.contact_tracker import FULL_ITERATIONS, IMAGES_RELEASED, LOST_STDDEV, ContactTracker
from finforce_ifea.tracking.friction import Coefficient


class FilterTracker(ContactTracker):
    """Takes the place of `ContactTracker`: objects, mechanics and lateral loads are its own.

    Friction is a state with a prior that every image updates.
    """

    search_type = FilterSearch
    _search: FilterSearch
    _tare: Tare | None = None

    def update(self, points: NDArray, tare: Tare, dt: float, observation: Observation) -> ContactState | None:
        """See `ContactTracker.update`."""
        search, measured = self._search, points - tare.offsets
        if tare is not self._tare:
            self._tare = tare
            search.restart()
        search.expectation["shared"] = observation.shared
        planar = measured - self._lateral.motions if self._is_known else measured
        self._fill(planar, tare, tare.point_noise(observation.stddev))
        most = FULL_ITERATIONS if self._fidelity else self.settings.iterations
        if not search.find(self._contact, self._traction, self._probe, dt, iterations=most, is_sudden=False):
            search.lose(LOST_STDDEV)
            return None
        state = search.state
        self._released = self._released + 1 if state["depth"] < TOUCH_DEPTH else 0
        if self._released == IMAGES_RELEASED:
            self._forget_contact()
            if self.settings.may_be_held:
                search.let_go()
        self._complete(state)
        if self._is_known:
            bend = search.positions[:, 0] - self._rest[:, 0]
            self._lateral.update((measured - search.positions)[:, 1], bend, search.points, state)
        self._change_fidelity(state)
        self._slides = True
        return state

    def learn(self) -> None:
        """Follow the path of the object, which the force of the last image did not wait for."""
        if self._slides:
            self._slides = False
            self._search.follow_path(self._contact)

    def expect_friction(self, friction: Coefficient | None) -> None:
        """See `ContactTracker.expect_friction`."""
        unknown = Coefficient(self.settings.friction, self.settings.friction_stddev)
        self._search.expect_friction(unknown if friction is None else friction)

    @property
    def friction(self) -> Coefficient:
        """What is known of the object's coefficient of friction."""
        return self._search.friction

    def _find_traction(self, normal: float) -> float:
        """Return no further uncertainty of the traction: the covariance has it."""
        return 0.0

    def _find_clearance_stddev(self, state: ContactState, height: float) -> float:
        """See `ContactTracker`; the covariance is that of the filter's state."""
        known = state.copy()
        known["covariance"] = self._search.contact_covariance()
        return super()._find_clearance_stddev(known, height)
