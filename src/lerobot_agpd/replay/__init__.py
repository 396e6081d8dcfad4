"""The replay T: demonstrations and kept episodes, in memory for training and as LeRobotDatasets on disk."""
