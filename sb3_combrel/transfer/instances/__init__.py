"""Source instances that join the target's: translated, selected by compliance, ranked by relevance."""
