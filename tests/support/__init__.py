"""Scenes, samples and references that several test modules share."""
