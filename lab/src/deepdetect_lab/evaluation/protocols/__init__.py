"""Protocols: how to measure on data of one kind, and which tables and figures to make."""
