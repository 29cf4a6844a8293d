"""Measurements of speed; nothing here is needed to run insitu."""
