"""Cross-validation: a traverse solved again with halves of its tracks."""
