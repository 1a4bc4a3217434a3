"""What is believed of a system, as text that other tools read."""
