"""The verbs of insitu, one per file."""
