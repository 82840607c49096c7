"""Inter-task mappings, sets of them, and what a user may write for a set."""
