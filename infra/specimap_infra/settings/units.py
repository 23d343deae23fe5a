"""Units of bytes in settings."""

MIB = 1024**2
GIB = 1024**3
