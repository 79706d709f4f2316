"""Claims about images that do not arrive: which are noticed, what is said, and what is no loss."""

import math

import numpy as np
import pytest

from finforce.ros.transport import PROFILES, remedy_for_losses
from finforce_keypoints.arrivals import Arrivals

SECOND = 1_000_000_000  # ns
BUSY = 0.0  # s that a process had nothing to do


def shoot(rate, seconds=10.0, jitter=0.02, seed=0):
    """Stamps [ns] of a camera of some rate [Hz], off by a share of the period."""
    count, period = int(rate * seconds), SECOND / rate
    off = np.random.default_rng(seed).normal(0.0, jitter * period, count)
    return (10**6 * SECOND + period * np.arange(count) + off).astype(np.int64)


def lose(stamps, share, together=1, seed=1):
    """Return the stamps that are left where a share of them is lost, so many at a time."""
    rng, kept, number = np.random.default_rng(seed), np.ones(len(stamps), dtype=bool), 0
    while number < len(stamps):
        is_lost = rng.random() < share / (share + together * (1.0 - share))
        kept[number : number + together] = not is_lost
        number += together if is_lost else 1
    return stamps[kept]


def watch(stamps, spare=math.inf, infos=()):
    arrivals = Arrivals()
    for stamp in infos:
        arrivals.announce(int(stamp))
    for stamp in stamps:
        arrivals.take(int(stamp), spare)
    return arrivals.count_losses()


@pytest.mark.parametrize("has_infos", [False, True])
@pytest.mark.parametrize("together", [1, 2])
@pytest.mark.parametrize("share", [0.05, 0.25, 0.6])
@pytest.mark.parametrize("rate", [15, 30, 90])
def test_images_that_get_lost_are_counted_within_ten_seconds(rate, share, together, has_infos):
    for seed in range(5):
        sent = shoot(rate, seed=seed)
        came = lose(sent, share, together, seed=100 + seed)
        losses, true = watch(came, infos=sent if has_infos else ()), 1.0 - len(came) / len(sent)
        assert losses.are_many or len(came) == len(sent)  # a draw without a loss
        found = losses.lost / (losses.arrived + losses.lost)
        # those beside the first and the last image do not count, nor those between which no period shows
        assert found == pytest.approx(true, abs=0.02 + 0.25 * true) and losses.unsent == losses.overtaken == 0


@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("rate", [15, 30, 90])
def test_nothing_is_lost_of_a_camera_of_fixed_rate_whatever_its_jitter(rate, jitter):
    for seed in range(10):
        stamps = shoot(rate, jitter=jitter, seed=seed)
        assert not watch(stamps).are_many and not watch(stamps, infos=stamps).are_many


def from_gaps(*parts):
    """Stamps [ns] from gaps [ms]."""
    gaps = np.concatenate(parts)
    return (10**6 * SECOND + 1e6 * np.cumsum(gaps)).astype(np.int64)


RNG = np.random.default_rng(5)
VARIABLE = {
    "slower in the dark": from_gaps(np.full(90, 33.3), np.full(60, 66.7)),
    "again and again": from_gaps(*[np.full(30, gap) for gap in (33.3, 66.7, 33.3, 50.0, 33.3, 100.0)]),
    "drifting": from_gaps(np.linspace(33.3, 66.7, 200)),
    "at random": from_gaps(RNG.uniform(25.0, 80.0, 190)),
    "a pause": from_gaps(np.full(100, 33.3), [3000.0], np.full(90, 33.3)),
    "one hiccup": from_gaps(np.full(100, 33.3), [66.6], np.full(150, 33.3)),
    "stamped on arrival": from_gaps(np.tile([3.0, 3.0, 94.0], 60)),
    "by turns late": from_gaps(np.tile([20.0, 46.0], 100) + RNG.normal(0.0, 3.0, 200)),
}


@pytest.mark.parametrize("name", VARIABLE)
def test_a_camera_of_variable_rate_loses_nothing(name):
    assert not watch(VARIABLE[name]).are_many


def test_a_recording_that_begins_again_loses_nothing():
    stamps = shoot(30, 6.0)
    assert not watch(np.concatenate((stamps, stamps, stamps))).are_many
    arrivals = Arrivals()
    for number, stamp in enumerate(stamps):
        if number % 40 == 0:
            arrivals.reset()  # nobody listened for a while
        elif number % 40 > 8:
            arrivals.take(int(stamp), math.inf)
    assert not arrivals.count_losses().are_many


def test_images_that_are_always_lost_by_turns_show_by_their_camera_info_alone():
    sent = shoot(30)
    assert not watch(sent[::2]).are_many
    assert watch(sent[::2], infos=sent).lost == pytest.approx(len(sent) / 2, abs=2)


def test_images_that_go_missing_with_their_camera_info_were_not_sent():
    sent = lose(shoot(30), 0.25)
    came = lose(sent, 0.1, seed=3)
    losses = watch(came, infos=sent)
    assert losses.lost == pytest.approx(len(sent) - len(came), abs=2)
    assert losses.unsent == pytest.approx(300 - len(sent), abs=12)
    text = losses.warn("colour", "do this")
    assert "of the colour images do not arrive: do this" in text and "the camera's driver drops them" in text


def test_camera_info_at_a_rate_of_its_own_counts_no_images():
    assert not watch(shoot(30), infos=shoot(100)).are_many


def test_what_a_busy_process_does_not_take_was_overtaken():
    came = lose(shoot(90), 0.25)
    losses = watch(came, BUSY)
    assert losses.overtaken > 150 and losses.lost == 0 and not losses.are_many and "overtaken" in str(losses)
    # one that had time for one image of two lost ones
    gaps = np.tile([1, 1, 1, 3], 60)
    losses = watch(from_gaps(11.1 * gaps), 1.0 * 0.0111)
    assert losses.lost == pytest.approx(losses.overtaken, abs=1)


def test_the_remedy_is_that_for_where_the_images_come_from():
    ends = (("/c", True), ("/c", False), ("/c/compressed", False))
    here, there, packed = (remedy_for_losses(*end) for end in ends)
    assert PROFILES in here and "rmem_max" not in here
    assert "net.core.rmem_max" in there and "compressed" in there and "or use" not in packed


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(8))
def test_images_at_any_times_are_counted(seed):
    """Of a starved process the gaps are anything; two kinds of tiny ones may have nothing near their median."""
    random = np.random.default_rng(seed)
    for _ in range(60):
        gaps = random.exponential(33.0, random.integers(2, 40)) * random.choice([1.0, 0.05], p=[0.9, 0.1])
        losses = watch(10**6 * SECOND + np.cumsum(1 + (1e6 * gaps).astype(np.int64)))
        assert losses.lost >= 0
