"""The error budget: what the stages' stated uncertainties make of the final pixels."""
