"""What `lerobot-agpd-doctor` looks at: the installation, and the folder of a run."""
