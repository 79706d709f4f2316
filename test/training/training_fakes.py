"""Pictures of a jaw that is nothing but coloured blobs, and hidden ones, for tests of the training."""

import numpy as np

from training.dataset import MARGIN, LabelledPictures, save_shard

HEIGHT, WIDTH, POINTS = 224, 176, 16
REST = np.column_stack((40.0 + 90.0 * (np.arange(POINTS) % 2), 20.0 + 12.0 * np.arange(POINTS))) + MARGIN
COLORS = np.random.default_rng(5).uniform(60, 255, (POINTS, 3))


def draw_blobs(count, seed):
    """Pictures (count) with a blob of its own colour at every visible point, some 3 px wide."""
    rng = np.random.default_rng(seed)
    shape = (HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN)
    rows, columns = np.indices(shape)
    xz = (REST + rng.uniform(-6.0, 6.0, (count, 1, 2)) + rng.uniform(-3.0, 3.0, (count, POINTS, 2))).astype(np.float32)
    visible = rng.random((count, POINTS)) > 0.2
    picture = np.full((count, *shape, 3), 40.0)
    for i in range(count):
        for k in np.flatnonzero(visible[i]):
            square = (columns - xz[i, k, 0]) ** 2 + (rows - xz[i, k, 1]) ** 2
            picture[i] += np.exp(-square / 18.0)[..., None] * (COLORS[k] - 40.0)
    picture += rng.normal(0.0, 2.0, picture.shape)
    return LabelledPictures(picture=np.clip(picture, 0, 255).astype(np.uint8), xz=xz, visible=visible)


def write_blobs(folder, train=48, validation=8):
    """A data set of blobs in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    save_shard(folder / "train_0000.npz", draw_blobs(train, 1))
    save_shard(folder / "val_0000.npz", draw_blobs(validation, 2))
    return folder
