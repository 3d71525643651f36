"""What training and rendering cost: see docs/speed.md."""
