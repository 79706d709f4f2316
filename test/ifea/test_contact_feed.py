"""Claims about which images wait for their contact: those of which it can be expected in time."""

import numpy as np
import pytest
from std_msgs.msg import Header

from finforce.messages import CloudColumns
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.messages import ContactFeed, columns_from_outline
from finforce_ifea.observation import Contact

PERIOD, TIMEOUT = 33_000_000, 0.008
FRAME = "left_jaw"


@pytest.fixture
def feed():
    return ContactFeed(frame=FRAME, fixed=None, free=False, max_age=200_000_000, timeout=TIMEOUT)


def say(feed, image, late, *, outline=True):
    """Contact and outline of an image, so much [s] after it; whether that is all that the image waits for."""
    place = {name: np.array([0.03], np.float32) for name in "xyz"}
    if outline:
        feed.take_outline(CloudColumns(Header(frame_id=FRAME), columns_from_outline(None)), image * PERIOD)
    feed.take(CloudColumns(Header(frame_id=FRAME), place), image * PERIOD)
    return feed.completes(1e-9 * image * PERIOD + late)


def expect(feed, image):
    return feed.expect(image * PERIOD, 1e-9 * image * PERIOD)


def test_an_image_waits_after_two_whose_contacts_came_in_time(feed):
    waits = []
    for image in range(1, 5):
        waits.append(expect(feed, image))
        assert say(feed, image, 0.004)
    assert waits == [False, False, True, True]


def test_contacts_that_come_late_are_not_waited_for(feed):
    for image in range(1, 5):
        assert not expect(feed, image)
        assert say(feed, image, 2.0 * TIMEOUT)  # there, but nobody waits any more


def test_one_that_fails_to_come_ends_the_waiting_until_two_are_in_time_again(feed):
    for image in (1, 2, 3):
        expect(feed, image)
        say(feed, image, 0.0)
    assert expect(feed, 4)  # in vain
    waits = []
    for image in range(5, 9):
        waits.append(expect(feed, image))
        say(feed, image, 0.001)
    assert waits == [False, False, True, True]


def test_a_contact_before_its_image_is_in_time_and_nothing_has_to_be_waited_for(feed):
    for image in range(1, 5):
        say(feed, image, -0.001)
        assert not expect(feed, image)
    assert expect(feed, 5)


def test_a_contact_of_every_third_image_alone_is_not_waited_for(feed):
    for image in range(1, 12):
        assert not expect(feed, image)
        if image % 3 == 0:
            say(feed, image, 0.001)


def test_a_contact_without_its_outline_is_not_whole(feed):
    for image in range(1, 5):
        assert not expect(feed, image)
        assert not say(feed, image, 0.001, outline=False)


def test_a_fixed_contact_is_there():
    fixed = Contact.fixed(load_jaw("bench"), 0.04)
    feed = ContactFeed(frame=FRAME, fixed=fixed, free=False, max_age=1, timeout=TIMEOUT)
    assert not any(expect(feed, image) for image in range(5)) and feed.at(10**12) is fixed
