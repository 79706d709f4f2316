"""Pictures of fingers that are nothing but a ladder on grey, for tests of the training."""

import cv2
import numpy as np

from lab.training.pictures import MARGIN, FingerPictures, save_shard

HEIGHT, WIDTH, KEYPOINTS, POINTS = 224, 176, 8, 12


def draw_ladders(fingers, each, seed):
    """Pictures of ladders with rungs of their own, moved by some pixels; a fifth of the points is covered."""
    rng = np.random.default_rng(seed)
    columns = {name: [] for name in ("picture", "rest", "place", "visible", "template", "finger")}
    for finger in range(fingers):
        heights = np.sort(rng.uniform(50.0, 190.0, KEYPOINTS // 2))
        rest = np.array([(x, y) for y in heights for x in (60.0, 110.0)])
        rest = np.vstack((rest, rng.uniform((60.0, 50.0), (110.0, 190.0), (POINTS - KEYPOINTS, 2))))
        columns["template"].append(_draw(rest, np.zeros((HEIGHT, WIDTH, 3), np.uint8), (255, 0, 0)))
        for _ in range(each):
            move = rng.uniform(-6.0, 6.0, 2)
            picture = rng.integers(30, 60, (HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, 3), dtype=np.uint8)
            picture = _draw(rest + move + MARGIN, picture, tuple(int(v) for v in rng.integers(120, 255, 3)))
            visible = rng.random(POINTS) > 0.2
            place = rest + move + MARGIN
            for x, y in place[~visible].round().astype(int):
                cv2.circle(picture, (int(x), int(y)), 9, (0, 0, 0), -1)
            for name, value in (("picture", picture), ("rest", rest), ("place", place), ("visible", visible)):
                columns[name].append(value)
            columns["finger"].append(finger)
    return FingerPictures(
        picture=np.array(columns["picture"]),
        rest=np.array(columns["rest"], dtype=np.float32),
        place=np.array(columns["place"], dtype=np.float32),
        visible=np.array(columns["visible"]),
        keypoints=np.full(len(columns["picture"]), KEYPOINTS),
        template=np.array(columns["template"]),
        finger=np.array(columns["finger"]),
    )


def _draw(points, image, color):
    for first, second in zip(points[:KEYPOINTS:2], points[1:KEYPOINTS:2], strict=True):
        ends = [tuple(int(v) for v in point.round()) for point in (first, second)]
        cv2.line(image, *ends, color, 3, cv2.LINE_AA)
    for side in (0, 1):
        ends = [tuple(int(v) for v in points[row].round()) for row in (side, KEYPOINTS - 2 + side)]
        cv2.line(image, *ends, color, 4, cv2.LINE_AA)
    return image


def write_ladders(folder, fingers=4, each=4):
    """A data set of ladders in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    save_shard(folder / "train_0000.npz", draw_ladders(fingers, each, 1))
    save_shard(folder / "val_0000.npz", draw_ladders(2, 2, 2))
    return folder
