"""Wrong input by the ten thousand: `python -m fuzz`, or `make fuzz`."""
