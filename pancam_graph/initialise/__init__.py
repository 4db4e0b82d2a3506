"""First values of what the adjustment estimates."""
