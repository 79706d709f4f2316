"""The work that a key point detector leaves out, by the names of its rules; applies none of them."""

from finforce_skipping import IDLE, STILL

UNSEEN = "jaw not in view"
ANNOTATED = "annotated image not wanted"
RULES = (STILL, IDLE, UNSEEN, ANNOTATED)

LOOK_EVERY = 4.0  # [s] after which an image is looked at in full though nothing has moved
SEARCHED = 30  # images in each of which a lost jaw is looked for
SEARCH_EVERY = 5  # images, in one of which it is looked for from then on
