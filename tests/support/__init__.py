"""What several test modules share: scenes, samples, references."""
