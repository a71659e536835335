"""filterlab."""
