"""Geometry for NeuS, instant-nsr-pl and nerfstudio."""
