"""Which rays a reconstruction trains on."""
