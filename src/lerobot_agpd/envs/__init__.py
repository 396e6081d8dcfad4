"""Simulated environments that this plugin adds to LeRobot, and scripted experts for them."""
