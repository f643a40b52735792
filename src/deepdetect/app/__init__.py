"""The page in a browser, served on this computer, with what Python does better."""
