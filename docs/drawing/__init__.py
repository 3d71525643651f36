"""The diagrams of the documentation, drawn from what the code computes."""
