"""Models the environments are built from, one folder per robot."""
