"""Networks: SIREN, the multiscale SDF, textures, radiance and encodings."""
