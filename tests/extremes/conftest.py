"""Searches of hypothesis are the same on every run."""

from hypothesis import settings

settings.register_profile("extremes", derandomize=True, deadline=None, max_examples=30, database=None)
settings.load_profile("extremes")
