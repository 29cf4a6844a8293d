"""Photographs: RAW files, radiometry, colour, error measures, display."""
