"""Volume rendering of signed distance fields (NeuS)."""
