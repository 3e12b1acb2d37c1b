"""Fused kernels in Triton for CUDA; only `switch` loads without Triton."""
