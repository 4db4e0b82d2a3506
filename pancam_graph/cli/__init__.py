"""The `pancam-graph` command."""
