"""Guided rollouts: strategies, success filter, episodes."""
