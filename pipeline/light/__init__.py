"""Light: directions on the lat-long, mirror balls, environment maps."""
