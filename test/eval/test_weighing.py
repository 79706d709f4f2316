"""Claims about the stiffness that a kitchen scale tells."""

import json
from importlib import resources

import numpy as np
import pytest
from eval_fakes import cut

from finforce_eval.calibration.weighing import GRAVITY, Hold, calibrate_with_scale, find_holds, weigh
from finforce_eval.cli.main import main, parse
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_ifea.errors import CalibrationError
from finforce_ifea.jaw.calibration import load_calibration, save_calibration
from finforce_ifea.jaw.jaw import load_jaw

RECORDING = resources.files("finforce_eval").joinpath("data", "bench_cyl25_middle")
RATE = 30.0


def staircase(levels, hold=4.0, ramp=0.5, noise=0.01):
    """Force [N] at 30 Hz: ramps between levels that are held, with a decay of 5 % while held."""
    pieces, last = [], 0.0
    for level in levels:
        pieces.append(np.linspace(last, level, int(ramp * RATE), endpoint=False))
        time = np.arange(int(hold * RATE)) / RATE
        pieces.append(level * (0.95 + 0.05 * np.exp(-time)))
        last = pieces[-1][-1]
    force = np.concatenate(pieces)
    return np.arange(len(force)) / RATE, force + np.random.default_rng(3).normal(0.0, noise, len(force))


def test_each_held_force_is_found_once_and_read_at_its_end():
    holds = find_holds(*staircase([1.0, 3.0, 0.0, 2.0]))
    # the decay has ended but for e^-3.5 of 5 %; the noise of 30 images is 2 mN
    np.testing.assert_allclose([hold.force for hold in holds], [0.95, 2.85, 1.90], rtol=0.01)
    assert [hold.start for hold in holds] == sorted(hold.start for hold in holds)


def test_ramps_rest_and_short_stops_are_no_holds():
    times = np.arange(0.0, 20.0, 1.0 / RATE)
    assert find_holds(times, 0.2 * times) == []
    assert find_holds(times, np.full_like(times, 0.02)) == []
    assert find_holds(*staircase([1.0, 2.0], hold=1.0)) == []


def test_images_without_a_force_do_not_hide_a_hold():
    times, force = staircase([2.0])
    force[::7] = np.nan
    assert len(find_holds(times, force)) == 1


def held(forces):
    return [Hold(start=10.0 * i, end=10.0 * i + 4.0, force=force) for i, force in enumerate(forces)]


def test_the_factor_is_that_of_the_scale_over_the_estimate():
    weighing = weigh(held([0.8, 1.6, 2.4]), [100.0, 200.0, 300.0])
    assert weighing.factor == pytest.approx(0.1 * GRAVITY / 0.8)
    assert weighing.misfit == pytest.approx(0.0, abs=1e-12)


def test_a_reading_that_does_not_fit_shows_in_the_misfit_and_widens_the_uncertainty():
    good, bad = (weigh(held([1.0, 2.0, 3.0]), grams) for grams in ([102, 204, 306], [102, 165, 306]))
    assert bad.misfit > 0.08 > 10 * good.misfit
    assert bad.stddev > 2 * good.stddev


def test_another_number_of_readings_names_the_holds():
    with pytest.raises(RecordingError, match=r"2 readings for 1 holds; holds found: 0.0-4.0 s \(1.00 N\)"):
        weigh(held([1.0]), [100.0, 200.0])


def test_twice_as_many_readings_are_those_with_commas():
    with pytest.raises(RecordingError, match=r"4 readings for 2 holds \(decimal points, not commas\?\)"):
        weigh(held([1.0, 2.0]), [101.0, 9.0, 203.0, 8.0])


RISING = [0.8, 1.6, 2.3, 3.1, 3.9, 3.1]
READ = [1e3 * 1.1 * force / GRAVITY for force in [0.4, *RISING, 0.9]]


@pytest.mark.parametrize(
    ("grams", "hint"),
    [
        (READ[:6], "reading 2 fits hold 1: does reading 1 belong to a hold that was not found"),
        (READ[2:], "reading 1 fits hold 2: does a hold lack a reading"),
        (READ[1:6] + [10 * READ[6]], r"left over, expected at most 15 %; holds found: 0.0-4.0 s \(0.80 N\)"),
    ],
)
def test_readings_of_other_holds_are_refused_with_the_shift_that_fits(grams, hint):
    assert weigh(held(RISING), READ[1:7]).factor == pytest.approx(1.1)
    with pytest.raises(RecordingError, match=f"readings do not fit the holds.*{hint}"):
        weigh(held(RISING), grams)


def test_readings_of_a_scale_that_was_not_at_zero_are_refused_with_what_it_showed():
    with pytest.raises(RecordingError, match="each seems to have 50 g too much: was the scale at zero"):
        weigh(held(RISING), [reading + 50.0 for reading in READ[1:7]])
    alike = [1e3 * 1.1 * force / GRAVITY for force in (2.0, 2.05, 2.0)]  # tell nothing of an offset
    assert weigh(held([2.0, 2.05, 2.1]), alike).factor == pytest.approx(1.08, abs=0.02)


def test_noise_does_not_hide_a_hold_and_a_slow_press_stays_none():
    for seed in range(20):
        times, force = staircase([0.8, 1.6, 2.4, 1.6, 0.8], hold=3.0)
        # 30 mN, correlated over three images, as the first hold of the included recording shows
        noise = np.convolve(np.random.default_rng(seed).normal(0.0, 0.05, len(times) + 2), np.ones(3) / 3, "valid")
        assert len(find_holds(times, force + noise)) == 5
        slow = np.arange(0.0, 20.0, 1.0 / RATE)
        assert find_holds(slow, 0.2 * slow + np.random.default_rng(seed).normal(0.0, 0.01, len(slow))) == []


@pytest.mark.parametrize("grams", [[], [0.0], [-5.0], [float("nan")]])
def test_readings_that_no_scale_shows_are_refused(grams):
    with pytest.raises(RecordingError, match="expected grams above zero"):
        weigh(held([1.0] * len(grams)), grams)


def test_a_wrong_modulus_is_mended_by_weights(tmp_path, capsys):
    base = load_calibration("bench")
    wrong, mended = tmp_path / "wrong.yaml", tmp_path / "mended.yaml"
    save_calibration(base.changed(young_modulus=1.5 * base.young_modulus), wrong)
    whole = read_recording(RECORDING)
    begin = int(whole.jaw("left").keypoints.stamps_ns[0])
    bag = write_recording(cut(whole, begin, begin + 19 * 10**9), tmp_path / "four_holds")
    options = ["weigh", str(bag), "--contact", "fixed:case", "--calibration", str(wrong)]
    assert main(options) == 0
    spans = [line.split()[2:5:2] for line in capsys.readouterr().out.splitlines() if line.startswith("hold ")]
    assert len(spans) == 4  # the first one, too, whose noise is the largest share of its force
    track, truth = (getattr(whole.jaw("left"), name) for name in ("keypoints", "truth"))
    ends = track.stamps[0] + np.array([float(end) for _, end in spans])
    weights = [np.interp(end - 0.5, truth.stamps, np.abs(truth.force[:, 0])) for end in ends]
    grams = [f"{1e3 * weight / GRAVITY:.0f}" for weight in weights]
    assert main([*options, "--grams", *grams, "-o", str(mended), "--json", str(tmp_path / "found.json")]) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["calibration"]["young_modulus"] == load_calibration(mended).young_modulus
    assert len(found["holds"]) == len(grams) and 0.0 < found["factor"] < 1.0
    # the estimates of this recording are 2 % off
    assert load_calibration(mended).young_modulus == pytest.approx(base.young_modulus, rel=0.04)


def test_the_calibration_is_that_of_the_finger_with_its_modulus_scaled():
    times, forces = staircase([1.0, 3.0, 0.0, 2.0])
    calibration = calibrate_with_scale(times, -forces, [145.3, 436.0, 290.6], jaw="bench")
    assert calibration.young_modulus == pytest.approx(1.5 * 26e6, rel=0.01)
    assert (calibration.jaw, calibration.finger) == ("bench", load_jaw("bench").digest)
    vectors = np.stack([forces, 0.1 * forces, 0.0 * forces], axis=1)
    assert calibrate_with_scale(times, vectors, [145.3, 436.0, 290.6], jaw="bench") == calibration


@pytest.mark.parametrize(("unit", "grams"), [("kilograms", 1e3), ("ounces", 28.35)])
def test_readings_in_another_unit_are_named(unit, grams):
    times, forces = staircase([1.0, 3.0, 0.0, 2.0])
    with pytest.raises(CalibrationError, match=f"look like {unit}, in grams they are 145 436 291$"):
        calibrate_with_scale(times, forces, np.array([145.3, 436.0, 290.6]) / grams, jaw="bench")


def test_newtons_given_as_grams_are_refused_and_named():
    times, forces = staircase([1.0, 3.0, 0.0, 2.0])
    newtons = [1.425, 4.275, 2.85]
    with pytest.raises(
        CalibrationError, match="modulus 0.38.* MPa.* look like newtons, in grams they are 145 436 291$"
    ):
        calibrate_with_scale(times, forces, newtons, jaw="bench")
    taken = calibrate_with_scale(times, forces, newtons, jaw="bench", force=True)
    assert taken.young_modulus == pytest.approx(1.5 * 26e6 * 1e-3 * GRAVITY, rel=0.01)


def test_readings_may_be_separated_by_commas():
    for words in (["160", "238"], ["160,238"], ["160,", "238"]):
        options = parse(["weigh", str(RECORDING), "--grams", *words])
        assert [reading for word in options.grams for reading in word] == [160.0, 238.0]


def test_an_output_without_readings_is_refused(tmp_path, capsys):
    assert main(["weigh", str(RECORDING), "-o", str(tmp_path / "none.yaml")]) == 2
    assert "-o needs --grams" in capsys.readouterr().err
