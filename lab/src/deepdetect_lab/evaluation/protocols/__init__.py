"""Protocols: measurements on data of one kind, and their tables and figures."""
