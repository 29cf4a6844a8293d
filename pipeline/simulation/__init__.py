"""Captures with known truth. Shares no estimation code with the stages it tests."""
