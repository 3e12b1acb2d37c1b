"""Reconstructions of photographs: the multiscale geometry beside that of NeuS."""
