"""A web page served on this computer only, for tasks that run in Python."""
