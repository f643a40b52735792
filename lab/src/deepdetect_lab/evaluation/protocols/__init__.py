"""Protocols: what is measured, on any data of their kind, as tasks, tables and figures."""
