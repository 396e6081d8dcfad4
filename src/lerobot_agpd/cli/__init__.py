"""Console commands, `lerobot-agpd-*`, one file each."""
