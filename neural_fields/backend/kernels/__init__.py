"""Fused kernels in Triton: whole sweeps of a network in one launch, for CUDA.

`switch` says when they are used, and loads without Triton; the other files are imported when they are, by the fields.
"""
