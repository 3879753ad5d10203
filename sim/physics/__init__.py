"""What the emulated devices feel and move, one idea a file."""
