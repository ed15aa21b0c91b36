"""From one measured step to a PD gain you can trust."""

__version__ = "0.1.0"
