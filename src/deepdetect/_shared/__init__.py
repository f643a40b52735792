"""Code that all other packages use: errors, registries, options, files, parallel work."""
