"""Speed against accuracy, measured: every knob alone, presets, and designed combinations."""
