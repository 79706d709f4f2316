"""RGB-D images to key points in the jaw frames, by a network or by dots; see docs/keypoints.md."""
