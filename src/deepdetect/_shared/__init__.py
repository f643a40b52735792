"""What every other package uses: errors, options, files, processes."""
