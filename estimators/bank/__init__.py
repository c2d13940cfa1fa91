"""A bank of pose filters that follows several hypotheses."""
