"""What is written beside policies and datasets for those who download them: how each was made, and how to use it."""
