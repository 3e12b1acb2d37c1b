"""nerfstudio's methods ``mplicits`` and ``mplicits-facto``, and the way of their surfaces into files.

nerfstudio finds the methods by its entry points; nothing in this package imports this room. See docs/drop-in.md.
"""
