"""The collection strategies, one file each."""
