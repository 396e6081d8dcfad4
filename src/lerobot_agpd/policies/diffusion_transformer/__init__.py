"""Diffusion policy with an exchangeable denoiser."""
