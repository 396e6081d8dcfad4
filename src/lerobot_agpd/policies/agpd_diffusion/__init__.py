"""The diffusion student trained by AGPD."""
