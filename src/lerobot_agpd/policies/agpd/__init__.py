"""The ACT student trained by AGPD."""
