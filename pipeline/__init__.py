"""The nouns of insitu: photographs, cameras, light, transport, and the plumbing that joins the stages."""

__version__ = "0.1.0"
