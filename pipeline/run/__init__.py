"""Plumbing: what a stage is, how it is run, and how a user asks for it."""
