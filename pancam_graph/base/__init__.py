"""The ground: errors, geometry, threads, files that appear whole, compiled code kept on disk."""
