"""Sphere tracing of fields, on the host and on accelerators."""
