"""``reconstruct``: from posed photographs to a surface with colours."""
