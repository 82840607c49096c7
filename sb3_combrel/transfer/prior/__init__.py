"""A source as the prior of the target's model: copies of it in the target, which are chosen, and what they may claim."""
