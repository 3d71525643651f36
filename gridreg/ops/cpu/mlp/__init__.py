"""Small networks: encodings and layers in one kernel."""
