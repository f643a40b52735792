"""The acceptance set: image pairs of many kinds with known geometry, to judge matching engines."""
