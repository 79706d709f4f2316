"""Material constants from recordings with a force sensor or a kitchen scale."""
