"""A folder of photographs before it is a capture: what each shows, which belong together, what is still missing."""
