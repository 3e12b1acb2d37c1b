"""Fields of space and time: slices, velocities, flows and laws of evolution."""
