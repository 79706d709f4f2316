"""From the start of a slip to its alarm, and false alarms at rest, by the rate and the noise of an object's poses.

    python benchmarks/slip.py [--json report/slip.json]

Poses of an object that rests on a jaw and, from a random moment on, slides along it at 5 mm/s; white noise on all
three axes.
"""

import argparse

import numpy as np

from finforce_contact.localization.slip import SlipWatch, TouchedFace
from finforce_contact.settings import ContactSettings
from finforce_eval.evaluation.machine import write_json

FACE = TouchedFace(point=np.array([0.012, 0.0, 0.040]), tangent=np.array([0.0, 0.0, 1.0]))
SPEED, BEGIN = 5e-3, 4.0
# Rate [Hz] and noise of each axis [m].
CASES = ((30.0, 0.1e-3), (30.0, 0.2e-3), (30.0, 0.4e-3), (90.0, 0.2e-3), (10.0, 0.3e-3))
SLIPS, MINUTES = 40, 10


def watch(rate: float, noise: float, begin: float, end: float, seed: int) -> list[tuple[float, bool]]:
    """Returns stamp [s] and whether the object is said to slide, pose after pose."""
    random, eyes = np.random.default_rng(seed), SlipWatch(ContactSettings())
    eyes.place(0.040)
    said = []
    for stamp in np.arange(0.0, end, 1.0 / rate):
        T = np.eye(4)
        T[:3, 3] = np.array([0.03, 0.0, 0.04 + SPEED * max(0.0, stamp - begin)]) + noise * random.standard_normal(3)
        said.append((stamp, eyes.update(stamp, T, FACE).sliding))
    return said


def measure(rate: float, noise: float) -> dict[str, float]:
    """Returns delays [ms] of slips, missed ones infinite, and false alarms per minute."""
    delays, alarms = [], 0
    for seed in range(SLIPS):
        begin = BEGIN + 0.37 * seed / 20
        said = watch(rate, noise, begin, 6.0, seed)
        delays.append(next((1e3 * (stamp - begin) for stamp, slides in said if slides and stamp > begin), np.inf))
    for seed in range(MINUTES // 2):
        slides = [now for _, now in watch(rate, noise, np.inf, 120.0, 100 + seed)]
        alarms += sum(now and not before for before, now in zip(slides, slides[1:], strict=False))
    middle, slow = np.percentile(delays, [50, 90])
    return {"delay_p50_ms": float(middle), "delay_p90_ms": float(slow), "false_alarms_per_minute": alarms / MINUTES}


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    options = parser.parse_args()
    found = {}
    print("poses            delay, median / 90 %   false alarms per minute")
    for rate, noise in CASES:
        case = measure(rate, noise)
        found[f"{rate:g} Hz, {1e3 * noise:g} mm"] = case
        times = f"{case['delay_p50_ms']:.0f} / {case['delay_p90_ms']:.0f} ms"
        print(f"{rate:3.0f} Hz, {1e3 * noise:.1f} mm   {times:>20}   {case['false_alarms_per_minute']:.1f}")
    if options.json:
        write_json(options.json, found)


if __name__ == "__main__":
    main()
