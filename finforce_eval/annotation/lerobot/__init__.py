"""LeRobot datasets: their layouts, videos and features, and the dataset written anew with forces."""
