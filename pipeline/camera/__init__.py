"""Cameras: lens model, poses, markers."""
