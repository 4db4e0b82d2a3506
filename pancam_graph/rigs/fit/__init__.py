"""Fit of a rig to cameras whose poses are known."""
