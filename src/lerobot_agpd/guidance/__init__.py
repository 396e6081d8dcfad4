"""Guided sampling: discrepancy J, representation, guided schedulers, teacher wrapper."""
