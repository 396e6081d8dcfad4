"""ACT with a diffusion prediction head (ACT-DP)."""
