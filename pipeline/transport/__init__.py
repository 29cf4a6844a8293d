"""Transport: scenes, materials and the path tracer."""
