"""Console commands of this plugin."""
