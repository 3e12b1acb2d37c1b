"""What every run needs: settings, folder, trainer, progress, devices.

This face is empty: the command line reads settings from here, and must not load torch for it.
"""
