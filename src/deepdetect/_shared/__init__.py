"""What every other package uses: errors, registries, options, files, parallel work."""
