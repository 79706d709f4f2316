"""Time against error: percentiles, and the points that no other beats."""

import numpy as np
import pytest

from finforce_eval.figures.time_error import ErrorPoint, ErrorSeries, draw_time_error, find_front, join_near, time_stats


def point(time, error, text="a"):
    return ErrorPoint(text=text, time=time, slow=2 * time, error=error)


def test_front_holds_what_no_other_beats_in_both():
    fast, good, beaten, late = point(1.0, 3.0), point(5.0, 1.0), point(2.0, 4.0), point(6.0, 1.0)
    assert find_front([late, beaten, good, fast]) == [fast, good]


def test_point_without_time_or_error_is_on_no_front():
    assert find_front([point(np.nan, 1.0), point(1.0, np.nan)]) == []


def test_percentiles_are_in_milliseconds():
    stats = time_stats(np.linspace(0.0, 0.1, 101))
    assert (stats.n, stats.p50, stats.p95, stats.p99, stats.max) == (
        101,
        *map(pytest.approx, (50.0, 95.0, 99.0, 100.0)),
    )


def test_nothing_was_timed_says_so():
    stats = time_stats([])
    assert stats.n == 0 and np.isnan(stats.p50)


def test_texts_of_neighbours_are_joined_and_of_others_not():
    near, far = [point(1.0, 1.0, "1"), point(1.1, 1.01, "5")], point(9.0, 1.0, "20")
    assert [joined.text for joined in join_near([*near, far])] == ["1 · 5", "20"]
    assert join_near([point(1.0, 1.0, "")]) == []


def test_picture_has_the_name_of_every_series(tmp_path):
    path = tmp_path / "front.svg"
    series = [
        ErrorSeries(name="always", points=[point(1.0, 2.0)]),
        ErrorSeries(name="at times", points=[], complete=False),
    ]
    draw_time_error(series, path, title="title", error="error [mm]")
    assert path.read_text().count('<g id="legend') == 1
