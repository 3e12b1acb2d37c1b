"""Devices, fixed shapes, threads, argument checks, files and kernels."""
