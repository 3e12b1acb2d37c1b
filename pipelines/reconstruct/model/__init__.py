"""The scene that is trained, its loss, and its steps."""
