"""Trainings of NeuS and instant-nsr-pl as they are, and with the lines of docs/drop-in.md."""
