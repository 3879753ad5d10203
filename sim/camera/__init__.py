"""Pictures of the simulated world, made without any graphics library."""
