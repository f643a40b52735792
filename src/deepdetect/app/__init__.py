"""The page in a browser, served on this computer, with tasks that run in Python."""
